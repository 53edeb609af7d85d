"""Augmented reality: what falls is held where real things would hold it, and hidden by what is before it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from app.ar.command import build_stage
from app.ar.composite import DARKEST, Backdrop, shadow_of
from app.ar.drop import plan_drops, rim_radius
from app.cli import run
from app.options import ArOptions
from app.runs.finished_run import read_run, tracked_frames
from manipulation.standing import body_axis
from perception.io.object_map import write_object_map
from perception.io.recordings.trajectory import Trajectory, write_trajectory
from perception.io.scan_folder import write_scan
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame, SupportPlane
from sim_assets.cell.drop_world import DropWorld, RecordedCamera, StaticObject, Toy
from sim_assets.objects.convex.perceived_mesh import measure, perceived_pieces
from sim_assets.rendering.camera import look_at

LENS = CameraIntrinsics(160, 120, 150.0, 150.0, 75.0, 65.0)
Standing = Callable[..., ObjectEstimate]


def axis_of(estimate: ObjectEstimate) -> np.ndarray:
    return body_axis(estimate.mesh.vertices, estimate.mesh.faces, estimate.category)


def static(estimate: ObjectEstimate) -> StaticObject:
    mesh = trimesh.Trimesh(estimate.mesh.vertices, estimate.mesh.faces, process=False)
    pieces = perceived_pieces(estimate.mesh, estimate.category, axis_of(estimate))
    return StaticObject(estimate.name, mesh, pieces, estimate.T_world_object)


def table_frame(T_world_camera: np.ndarray | None, lift: float = 0.0) -> RgbdFrame:
    """What a camera 0.5 m straight above an empty table measures, or above a block of a height."""
    depth = np.full((LENS.height, LENS.width), 0.5, np.float32)
    depth[:30, :40] -= lift
    rgb = np.full((LENS.height, LENS.width, 3), 180, np.uint8)
    return RgbdFrame(0.0, rgb, depth, LENS, T_world_camera)


ABOVE = look_at(np.array([0.0, 0.0, 0.5]), np.zeros(3))


@pytest.mark.parametrize("category", ["mug", "bowl"])
def test_balls_dropped_into_a_vessel_stay_in_it(standing: Standing, category: str) -> None:
    vessel = standing(category, 0, (0.1, -0.2))
    body = measure(vessel.mesh, vessel.category, axis_of(vessel))
    opening, top = rim_radius(body), vessel.mesh_world.vertices[:, 2].max()
    axis = np.array([*body.axis, 0]) + vessel.T_world_object[:3, 3]
    toys = [
        Toy(
            "ball", 0.3 * opening, axis * (1, 1, 0) + [*(0.4 * opening * turn), top + 0.1], 0.3 * i, (1, 0, 0)
        )
        for i, turn in enumerate(np.array([[1.0, 0.0], [-0.5, 0.8], [0.0, -1.0]]))
    ]
    world = DropWorld([static(vessel)], toys, SupportPlane(), np.eye(4), [])
    world.advance(2.5)
    away = np.linalg.norm(world.positions()[:, :2] - axis[:2], axis=1)
    floor = body.z[body.floor] + vessel.T_world_object[2, 3]
    assert (away < opening).all() and (world.positions()[:, 2] < top + 0.3 * opening).all()
    assert (world.positions()[:, 2] > floor + 0.3 * opening - 2e-3).all()  # nothing sinks through


def test_rain_falls_over_the_objects_and_rests_on_the_support(standing: Standing) -> None:
    objects = [standing("bowl", 0), standing("can", 1, (0.15, 0.0))]
    bodies = [measure(o.mesh, o.category, axis_of(o)) for o in objects]
    toys = plan_drops(objects, bodies, np.array([0, 0, 1.0]), 6, np.random.default_rng(0))
    assert len(toys) == 6 and len({toy.release for toy in toys}) == 6
    world = DropWorld([static(o) for o in objects], toys, SupportPlane(), np.eye(4), [])
    world.advance(2.0)
    assert (world.positions()[:, 2] > 0.004).all()


def test_a_toy_appears_in_the_pixel_its_place_projects_to_and_casts_a_shadow() -> None:
    toy = Toy("ball", 0.012, np.array([0.05, 0.03, 0.06]), 0.0, (1, 0, 0))
    world = DropWorld([], [toy], SupportPlane(), np.eye(4), [RecordedCamera(LENS, ABOVE)])
    bare, now = world.render(0, toys=False), world.render(0)
    world.close()
    local = ABOVE[:3, :3].T @ (toy.position - ABOVE[:3, 3])
    expected = LENS.fx * local[:2] / local[2] + (LENS.cx, LENS.cy)
    v, u = np.nonzero(now.toys)
    np.testing.assert_allclose((u.mean(), v.mean()), expected, atol=0.7)
    assert not bare.toys.any() and bare.depth.max() == pytest.approx(0.5, abs=2e-3)
    shadow = shadow_of(Backdrop.of(table_frame(ABOVE), bare), now)
    assert DARKEST <= shadow.min() < 0.9 and (shadow > 0.99).mean() > 0.8  # the ball hides most of it


def test_a_single_image_without_pose_is_enough(tmp_path: Path, standing: Standing) -> None:
    """Somebody's scan folder with an object map in it: the camera is the world."""
    estimate = standing("bowl", 3, (0.0, 0.0))
    T_camera_object = np.linalg.inv(ABOVE) @ estimate.T_world_object
    seen = ObjectEstimate(3, "bowl", estimate.code, T_camera_object, estimate.scale, estimate.mesh)
    write_scan(tmp_path / "mine", [table_frame(None)])
    write_object_map(tmp_path / "mine", [seen])
    out = tmp_path / "out"
    arguments = [
        "ar",
        str(tmp_path / "mine"),
        "--drops",
        "2",
        "--seconds",
        "0.6",
        "--out",
        str(out),
        "--quiet",
    ]
    assert run(arguments) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["success"] and report["metrics"]["n_toys"] == 2
    film = cv2.VideoCapture(str(out / "video.mp4"))
    frames = [image for good, image in iter(film.read, (False, None)) if good]
    film.release()
    assert len(frames) > 15 and frames[0].shape == (120, 160, 3)
    picture = np.asarray(Image.open(out / "pictures" / "000000.png")).astype(int)
    assert (np.abs(picture - 180).max(axis=-1) > 30).sum() > 50  # toys, or their shadows


def test_after_slam_the_film_goes_along_with_the_camera(tmp_path: Path, standing: Standing) -> None:
    """The run folder keeps keyframes; the film shows the sequence, each image from where it was tracked."""
    times, run_folder = 0.04 * np.arange(30), tmp_path / "map"
    poses = [look_at(np.array([0.004 * i, 0.0, 0.5]), np.array([0.004 * i, 0, 0])) for i in range(30)]
    sequence = [replace(table_frame(None), time=float(t)) for t in times]
    write_scan(tmp_path / "sequence", sequence)
    write_scan(run_folder / "scan", [replace(sequence[0], T_world_camera=poses[0])])
    write_object_map(run_folder, [standing("bowl")])
    lost = 7
    kept = [i for i in range(len(times)) if i != lost]
    write_trajectory(
        run_folder / "trajectory.txt", Trajectory.of(list(times[kept]), [poses[i] for i in kept])
    )
    settings = {"sequence": str(tmp_path / "sequence")}
    (run_folder / "report.json").write_text(json.dumps({"command": "slam", "settings": settings}))
    stage = build_stage(read_run(run_folder), ArOptions(run=run_folder, drops=1, seconds=0.6))
    stage.world.close()
    assert len(stage.frames) == 15 and len(stage.chosen) > 0  # too few to be played
    assert stage.frames[lost].time == pytest.approx(times[lost + 1])
    np.testing.assert_allclose(stage.frames[lost].T_world_camera, poses[lost + 1], atol=1e-6)
    stage = build_stage(read_run(run_folder), ArOptions(run=run_folder, drops=1, seconds=2.0))
    stage.world.close()
    assert len(stage.frames) == 29 and len(stage.chosen) == 0
    (tmp_path / "sequence" / "scene_camera.json").unlink()
    assert tracked_frames(run_folder, 2.0) == ()  # then keyframes have to do


def test_a_run_without_images_is_refused(
    tmp_path: Path, standing: Standing, capsys: pytest.CaptureFixture[str]
) -> None:
    write_object_map(tmp_path / "bare", [standing("can")])
    assert run(["ar", str(tmp_path / "bare"), "--out", str(tmp_path / "out")]) == 2
    assert "has no images" in capsys.readouterr().err
