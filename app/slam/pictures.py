"""Pictures of a SLAM run: plan of the map with both trajectories, keyframes with overlays, position error."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from app.drawing import color_of, draw_estimates
from perception.io.files import write_atomically
from perception.io.recordings.trajectory import Trajectory
from perception.slam.keyframes import Keyframe
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame

TRUE, FOUND, KEY = "#7a4fa3", "#e6a100", "#1b7f5c"  # purple, yellow and green, as in the paper's figure
_INK, _FAINT = "#22252b", "#7a7f8a"


@dataclass(frozen=True)
class MappedSequence:
    """Result of a run, as it is drawn.

    Attributes:
        objects: Objects of the map.
        trajectory: Estimated trajectory.
        keyframes: Keyframes of the run.
        truth: True trajectory, if it is known.
    """

    objects: Sequence[ObjectEstimate]
    trajectory: Trajectory
    keyframes: Sequence[Keyframe]
    truth: Trajectory | None = None


def new_figure(width: float, height: float) -> Any:
    """Return a matplotlib figure for files, without a display; sizes in inches at 100 dpi."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", pil_kwargs={"compress_level": 3})
    write_atomically(path, buffer.getvalue())


def write_map_picture(path: Path, mapped: MappedSequence, title: str) -> None:
    """Draw the plan of the map with trajectories, keyframes with the map overlaid, and the position error.

    Args:
        path: PNG file.
        mapped: Map and trajectories; without a true trajectory the error is omitted.
        title: Heading.
    """
    keyframes = mapped.keyframes
    figure = new_figure(16, 9)
    grid = figure.add_gridspec(
        2,
        3,
        width_ratios=(1.45, 0.9, 0.9),
        left=0.045,
        right=0.99,
        top=0.91,
        bottom=0.06,
        wspace=0.06,
        hspace=0.12,
    )
    figure.text(0.02, 0.955, title, fontsize=19, fontweight="bold", color=_INK)
    _draw_plan(figure.add_subplot(grid[0:2, 0]), mapped)
    chosen = (
        [keyframes[i] for i in np.linspace(0, len(keyframes) - 1, 3).round().astype(int)] if keyframes else []
    )
    for k, (key, place) in enumerate(zip(chosen, (grid[0, 1], grid[0, 2], grid[1, 1]))):
        axis = figure.add_subplot(place)
        axis.imshow(draw_estimates(enlarged(key.frame), mapped.objects, opacity=0.6))
        axis.set_axis_off()
        name = ("first", "middle", "last")[k]
        axis.set_title(f"the map over the {name} keyframe", loc="left", fontsize=12, color=_INK)
    if mapped.truth is not None and len(mapped.trajectory.times):
        _draw_error(figure.add_subplot(grid[1, 2]), mapped, mapped.truth)
    save_figure(figure, path)


def enlarged(frame: RgbdFrame, width: int = 960) -> RgbdFrame:
    """Upscale a frame to about ``width`` pixels, so that overlays are drawn at a higher resolution."""
    camera = frame.intrinsics
    factor = max(1, round(width / camera.width))
    size = (factor * camera.width, factor * camera.height)
    shift = (factor - 1) / 2  # pixel centres are at integers
    larger = CameraIntrinsics(
        *size, factor * camera.fx, factor * camera.fy, factor * camera.cx + shift, factor * camera.cy + shift
    )
    rgb = np.asarray(cv2.resize(np.ascontiguousarray(frame.rgb), size, interpolation=cv2.INTER_CUBIC))
    depth = np.asarray(cv2.resize(np.ascontiguousarray(frame.depth), size, interpolation=cv2.INTER_NEAREST))
    return RgbdFrame(frame.time, rgb, depth, larger, frame.T_world_camera)


def _draw_plan(axis: Any, mapped: MappedSequence) -> None:
    axis.set_aspect("equal")
    axis.set_title("from above [m]", loc="left", fontsize=12, color=_INK)
    for estimate in mapped.objects:
        points = estimate.mesh_world.vertices[:, :2]
        hull = points[ConvexHull(points).vertices]
        color = np.array(color_of(estimate.id)) / 255
        axis.fill(*hull.T, facecolor=(*color, 0.35), edgecolor=color, linewidth=1.5)
        axis.text(*hull.mean(axis=0), estimate.name.replace("_", " "), ha="center", va="center", fontsize=8.5)
    if mapped.truth is not None:
        axis.plot(
            *mapped.truth.Ts_world_camera[:, :2, 3].T,
            color=TRUE,
            linewidth=3.5,
            alpha=0.55,
            label="true camera",
        )
    positions = mapped.trajectory.Ts_world_camera[:, :2, 3]
    axis.plot(*positions.T, color=FOUND, linewidth=1.6, label="tracked camera")
    for key in mapped.keyframes:
        _draw_frustum(axis, key.T_world_camera)
    axis.plot([], [], color=KEY, linewidth=1.2, label="keyframes")
    axis.legend(loc="upper left", frameon=False, fontsize=10)
    axis.grid(color="#eceef1")
    for spine in axis.spines.values():
        spine.set_color("#d0d3d9")


def _draw_frustum(axis: Any, T: Float[np.ndarray, "4 4"], size: float = 0.05) -> None:
    corners = np.array([[0, 0, 0], [-0.6, 0, 1], [0.6, 0, 1], [0, 0, 0]]) * size
    axis.plot(*(corners @ T[:3, :3].T + T[:3, 3])[:, :2].T, color=KEY, linewidth=1.2)


def _draw_error(axis: Any, mapped: MappedSequence, truth: Trajectory) -> None:
    found = mapped.trajectory
    true = {round(t, 4): T for t, T in zip(truth.times, truth.Ts_world_camera)}
    both = [
        (t, T, true[round(t, 4)]) for t, T in zip(found.times, found.Ts_world_camera) if round(t, 4) in true
    ]
    if not both:
        axis.set_axis_off()
        return
    times = [t for t, *_ in both]
    errors = [1000 * np.linalg.norm(T[:3, 3] - G[:3, 3]) for _, T, G in both]
    axis.plot(times, errors, color=FOUND, linewidth=1.5)
    for key in mapped.keyframes:
        axis.axvline(key.frame.time, color=KEY, linewidth=0.7, alpha=0.5)
    axis.set_title("error of the camera position [mm] over time [s]", loc="left", fontsize=12, color=_INK)
    axis.set_ylim(bottom=0)
    axis.tick_params(colors=_FAINT)
    axis.grid(color="#eceef1")
