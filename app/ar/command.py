"""``nodeslam ar RUN``: few-shot augmented reality, the paper's application of complete shapes.

Reconstructed objects become static bodies in a physics simulation; toys are dropped over them and composited
into the recorded images with occlusion and shadows.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import trimesh
from jaxtyping import Float
from rich.markup import escape

from app.ar.composite import Backdrop, Image, composite
from app.ar.drop import plan_drops
from app.ar.surroundings import clutter, support_frame
from app.drawing import font
from app.errors import UsageError
from app.movie import MovieFile
from app.options import ArOptions
from app.runs.finished_run import FinishedRun, read_run, recorded_sequence, tracked_frames
from app.runs.report import ObjectReport, Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from manipulation.standing import body_axis
from perception.io.files import write_atomically
from perception.io.images import png_bytes
from perception.types import ObjectEstimate, RgbdFrame
from sim_assets.cell.drop_world import DropWorld, RecordedCamera, StaticObject
from sim_assets.objects.convex.perceived_mesh import measure, perceived_pieces

FPS = 25
PANELS = 2  # views side by side in the video
PICTURES = 12  # views of which a picture is kept
HOLD = 1.5  # [s] at the end
SEQUENCE, SEQUENCE_PERIOD = 20, 0.3  # as many images, as near in time [s], are a moving camera's
BEST_ELEVATION = np.deg2rad(45)  # of a view above the support
STILL = 0.01  # [m/s] at which a toy counts as lying


@dataclass(frozen=True)
class Stage:
    """Simulation and recorded images.

    Attributes:
        world: Physics simulation of the toys.
        objects: Reconstructed objects.
        frames: Recorded images.
        chosen: Indices of the images that the video shows side by side; empty for a sequence, which it plays.
    """

    world: DropWorld
    objects: Sequence[ObjectEstimate]
    frames: Sequence[RgbdFrame]
    chosen: Sequence[int]


def run(options: ArOptions, screen: Screen) -> Report:
    """Drop toys onto the scene of a finished run; write a video and pictures."""
    begin = time.perf_counter()
    source = read_run(options.run)
    if not source.frames:
        raise UsageError(f"{options.run} has no images (scan/): the toys are drawn into recorded images")
    folder = RunFolder.create(options, "ar", also_read=recorded_sequence(options.run))
    with screen.stage("Building the scene"):
        stage = build_stage(source, options)
    try:
        with screen.stage("Dropping and drawing"):
            _film(stage, options, folder, screen)
        positions, speeds = stage.world.positions(), stage.world.speeds()
    finally:
        stage.world.close()
    at_rest = int((speeds < STILL).sum())
    report = Report(
        command="ar",
        seed=options.seed,
        success=True,
        reason=f"{len(positions)} toys over {len(source.objects)} objects in {len(stage.frames)} images",
        timings={"total": time.perf_counter() - begin},
        objects=[ObjectReport(o.id, o.category) for o in source.objects],
        metrics={"n_toys": len(positions), "n_at_rest": at_rest, "positions": positions},
        settings={"run": str(options.run), "drops": options.drops, "seconds": options.seconds},
    )
    folder.write_report(report)
    screen.show(escape(f"{folder.path / 'video.mp4'}, overview.png and pictures/"))
    return report


def build_stage(source: FinishedRun, options: ArOptions) -> Stage:
    """Build the simulation; its cameras are the recorded views, or those of the sequence for a SLAM run."""
    frames = tracked_frames(source.path, options.seconds) or source.frames
    T_world_support = support_frame(source.objects, source.plane)
    bodies = [measure(o.mesh, o.category, _axis(o)) for o in source.objects]
    rng = np.random.default_rng(options.seed)
    toys = plan_drops(source.objects, bodies, source.plane.normal, options.drops, rng)
    world = DropWorld(
        [_static(estimate) for estimate in source.objects],
        toys,
        source.plane,
        T_world_support,
        [_view(frame) for frame in frames],
        clutter(source.frames, source.objects, T_world_support),
    )
    stage = Stage(world, source.objects, frames, ())
    return (
        stage
        if is_sequence(frames)
        else replace(stage, chosen=best_views(stage, source.plane.normal)[:PANELS])
    )


def _static(estimate: ObjectEstimate) -> StaticObject:
    mesh = trimesh.Trimesh(estimate.mesh.vertices, estimate.mesh.faces, process=False)
    pieces = perceived_pieces(estimate.mesh, estimate.category, _axis(estimate))
    return StaticObject(estimate.name, mesh, pieces, estimate.T_world_object)


def _axis(estimate: ObjectEstimate) -> Float[np.ndarray, "2"]:
    return body_axis(estimate.mesh.vertices, estimate.mesh.faces, estimate.category)


def _view(frame: RgbdFrame) -> RecordedCamera:
    assert frame.T_world_camera is not None
    return RecordedCamera(frame.intrinsics, frame.T_world_camera)


def _film(stage: Stage, options: ArOptions, folder: RunFolder, screen: Screen) -> None:
    """Simulate, write the video of the chosen views, and store pictures of the final state."""
    backdrops = {i: _backdrop(stage, i) for i in stage.chosen}
    count = round(options.seconds * FPS)
    movie = MovieFile(folder.path / "video.mp4", FPS)
    try:
        for number in range(count):
            stage.world.advance(1 / FPS)
            if not stage.chosen:
                index = _frame_at(stage.frames, number / FPS)
                if index not in backdrops:
                    backdrops = {index: _backdrop(stage, index)}
            panels = [composite(backdrop, stage.world.render(i)) for i, backdrop in backdrops.items()]
            movie.add(_side_by_side(panels))
            screen.update(f"{number + 1} of {count} images")
        movie.hold(HOLD)
    except BaseException:
        movie.discard()
        raise
    movie.close()
    _pictures(stage, folder, stage.chosen or (0,))


def _backdrop(stage: Stage, index: int) -> Backdrop:
    return Backdrop.of(stage.frames[index], stage.world.render(index, toys=False))


def _pictures(stage: Stage, folder: RunFolder, chosen: Sequence[int]) -> None:
    """Write the final state in up to PICTURES views, and ``overview.png`` with the chosen views."""
    spread = np.unique(np.linspace(0, len(stage.frames) - 1, PICTURES).round().astype(int))
    rows: list[Image] = []
    for index in sorted({int(i) for i in spread} | set(chosen)):
        backdrop = _backdrop(stage, index)
        image = composite(backdrop, stage.world.render(index))
        write_atomically(folder.path / "pictures" / f"{index:06d}.png", png_bytes(image))
        if index in chosen:
            pair = [_titled(backdrop.frame.rgb, "recorded"), _titled(image, "with simulated objects")]
            rows.append(_side_by_side(pair))
    write_atomically(folder.path / "overview.png", png_bytes(np.concatenate(rows)))


def is_sequence(frames: Sequence[RgbdFrame]) -> bool:
    """Return whether the images are a sequence of a moving camera rather than single views."""
    times = np.array([frame.time for frame in frames])
    return len(frames) >= SEQUENCE and float(np.median(np.diff(times))) <= SEQUENCE_PERIOD


def _frame_at(frames: Sequence[RgbdFrame], time: float) -> int:
    """Return the index of the image at a time in seconds after the first one, at most the last one."""
    times = np.array([frame.time for frame in frames]) - frames[0].time
    return int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(frames) - 1))


def best_views(stage: Stage, up: Float[np.ndarray, "3"]) -> list[int]:
    """Rank the views by the share of the objects inside the image and the elevation of the camera."""
    points = np.concatenate([estimate.mesh_world.vertices[::7] for estimate in stage.objects])
    scores = []
    for frame in stage.frames:
        T, lens = _view(frame).T_world_camera, frame.intrinsics
        local = (points - T[:3, 3]) @ T[:3, :3]
        pixels = local[:, :2] / np.maximum(local[:, 2:], 1e-6) * (lens.fx, lens.fy) + (lens.cx, lens.cy)
        inside = (local[:, 2] > 0.05) & (pixels > 0).all(axis=1)
        inside &= (pixels < (lens.width, lens.height)).all(axis=1)
        elevation = np.arcsin(np.clip(-T[:3, 2] @ up, -1, 1))
        scores.append(float(inside.mean()) - 0.4 * abs(elevation - BEST_ELEVATION))
    return [int(index) for index in np.argsort(-np.array(scores), kind="stable")]


def _side_by_side(panels: Sequence[Image]) -> Image:
    height = max(panel.shape[0] for panel in panels)
    scaled = [
        panel
        if panel.shape[0] == height
        else cv2.resize(panel, None, fx=height / panel.shape[0], fy=height / panel.shape[0])
        for panel in panels
    ]
    return np.concatenate(scaled, axis=1)


def _titled(image: Image, text: str) -> Image:
    from PIL import Image as Pillow
    from PIL import ImageDraw

    picture = Pillow.fromarray(image)
    pen = ImageDraw.Draw(picture)
    pen.text(
        (12, 8),
        text,
        fill=(255, 255, 255),
        font=font(20, bold=True),
        stroke_width=2,
        stroke_fill=(25, 25, 25),
    )
    return np.asarray(picture)
