"""What is on disk at each moment of a run, and the pictures made from it."""

import json
import threading

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from app.drawing import draw_detections, draw_estimates
from app.options import PackOptions
from app.runs.replay import Recorder, read_recording
from app.runs.report import ObjectReport
from app.runs.run_folder import RunFolder
from app.screen import Screen
from app.task.overview import Pictures, write_overview
from app.task.recording import CellRecorder
from app.task.run_control import Gate
from app.task.run_writer import Storage
from app.task.video import END, FOOTER, FPS, SCENE, SHOW, SIDE, SPEED, Film
from manipulation.execution import TaskEvent
from manipulation.standing import stand
from manipulation.types import Box, PickPlacePlan, Placement, TaskPlan
from perception.io.scan_folder import read_scan
from perception.pipeline import Detections
from perception.types import (
    CameraIntrinsics,
    ObjectDetection,
    ObjectEstimate,
    RgbdFrame,
    SupportPlane,
    TriangleMesh,
)
from sim_assets.cell.world import World

CAMERA = CameraIntrinsics(160, 120, 150.0, 150.0, 79.5, 59.5)


def frame():
    """From half a metre straight above the object, image x along world x."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = (0.4, -0.2, 0.55)
    rgb = np.full((120, 160, 3), 100, np.uint8)
    return RgbdFrame(0.0, rgb, np.full((120, 160), 0.55, np.float32), CAMERA, T)


def can(id=0, x=0.4):
    mesh = trimesh.creation.cylinder(radius=0.035, height=0.1, sections=24)
    T = np.eye(4)
    T[:3, 3] = (x, -0.2, 0.05)
    shape = TriangleMesh(mesh.vertices, mesh.faces)
    return ObjectEstimate(id, "can", np.zeros(16), T, np.full(3, 0.055), shape)


def test_a_mesh_is_painted_where_the_camera_sees_it():
    image = draw_estimates(frame(), [can()])
    columns = np.nonzero((image[55:] != 100).any(axis=-1))[1]  # the label stands above
    assert abs(columns.mean() - 79.5) < 2
    radius = 150 * 0.035 / 0.45  # the can's top is 45 cm from the camera
    assert np.ptp(columns) / 2 == pytest.approx(radius, abs=2)
    behind = draw_estimates(frame(), [can(x=-3.0)])
    np.testing.assert_array_equal(behind, frame().rgb)


def test_near_objects_hide_far_ones():
    low, high = can(0), can(1)
    T = np.array(high.T_world_object)
    T[2, 3] = 0.2
    image = draw_estimates(
        frame(), [ObjectEstimate(1, "can", np.zeros(16), T, high.scale, high.mesh), low], 1.0
    )
    alone = draw_estimates(frame(), [ObjectEstimate(1, "can", np.zeros(16), T, high.scale, high.mesh)], 1.0)
    np.testing.assert_array_equal(image[60, 80], alone[60, 80])


def test_masks_are_tinted_in_a_copy():
    mask = np.zeros((120, 160), bool)
    mask[50:70, 70:90] = True
    shot = frame()
    image = draw_detections(shot, [ObjectDetection("mug", 0.8, mask, instance_id=3)])
    assert (image[60, 80] != 100).any() and (image[110, 10] == 100).all() and (shot.rgb == 100).all()


def plan():
    items = {estimate.name: stand(estimate) for estimate in (can(0), can(1, 0.5))}
    placements = (Placement("can_0", (0.5, 0.27, 0.004), (0.0,)),)
    return TaskPlan("pack", items, placements, {"can_1": "too far"}, box=Box())


def test_overview_is_written_whole_or_of_what_there_is(tmp_path):
    mask = np.zeros((120, 160), bool)
    mask[50:70, 70:90] = True
    found = Detections(SupportPlane(), ((ObjectDetection("can", 0.8, mask, instance_id=0),),))
    scene = np.zeros((72, 96, 3), np.uint8)
    reports = [
        ObjectReport(0, "can", True, 0.001, 0.0, 1),
        ObjectReport(-1, "mug", False, reason="not perceived " * 9),
    ]
    whole = Pictures("Pack", "seed 1", scene, scene, scene, [frame()], found, [can()], plan(), reports)
    for name, pictures in {"whole.png": whole, "nothing.png": Pictures("Pack", "stopped early")}.items():
        write_overview(tmp_path / name, pictures)
        with Image.open(tmp_path / name) as image:
            assert min(image.size) > 1000
    assert (tmp_path / "whole.png").stat().st_size > (tmp_path / "nothing.png").stat().st_size


class StillWorld(World):
    """As much of the cell as storing a run needs."""

    def __init__(self):
        pass

    time = 1.5
    drawn = 0

    def overview_image(self, *size, camera="overview", **_):
        self.drawn += 1
        width, height = size or (96, 72)
        return np.zeros((height, width, 3), np.uint8)

    def observe(self, observer, rate=0.0):
        self.observer = observer

    def joint_positions(self):
        return np.zeros(7)

    def gripper_width(self):
        return 0.08


def film_of(path):
    film = cv2.VideoCapture(str(path))
    frames = [image for good, image in iter(film.read, (False, None)) if good]
    film.release()
    return frames


def test_film_has_its_length_and_appears_only_when_complete(tmp_path):
    world = StillWorld()
    film = Film(tmp_path / "video.mp4", "Pack", world)
    film.begin("scan")
    for _ in range(4):
        film.sample()
        film.sample()  # no image is due yet
        world.time += SPEED / FPS
    film.looked(frame())
    film.made("frames", [frame()])
    film.made("objects", [can()])
    assert not (tmp_path / "video.mp4").exists()
    film.close()
    frames = film_of(tmp_path / "video.mp4")
    assert len(frames) == 4 + 1 + round(SHOW * FPS) + 1 + round(END * FPS)
    assert frames[0].shape == (SCENE[1] + FOOTER, SCENE[0] + SIDE[0], 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["video.mp4", "video.webp"]
    assert world.drawn == 2  # cell and wrist once: nothing moved afterwards


def test_film_shows_where_the_robot_believes_objects_to_be(tmp_path):
    film = Film(tmp_path / "video.mp4", "Pack", StillWorld())
    objects = [can(0), can(1, 0.5)]
    film.made("frames", [frame()])
    film.made("objects", objects)
    film.made("plan", plan())
    film.begin("execute")
    before = film.belief.copy()
    rest = np.eye(4)
    rest[:3, 3] = (0.5, 0.27, 0.004)
    moves = object.__new__(PickPlacePlan)  # all that is asked of it is where the object ends
    object.__setattr__(moves, "T_world_stand_rest", rest)
    film.event(TaskEvent("approach", "can_0", 0, 1, plan=moves))
    np.testing.assert_array_equal(film.belief, before)
    film.event(TaskEvent("placed", "can_0", 1, 1))
    assert (film.belief != before).any()
    film.discard()
    assert not list(tmp_path.glob("*.mp4"))


class StillRecorder(CellRecorder):
    """Records that nothing moves."""

    def __init__(self, world):
        self.world, self.recorder, self._lock = world, Recorder(), threading.Lock()


def test_a_run_that_is_killed_leaves_what_was_finished(tmp_path):
    options = PackOptions(out=tmp_path / "run", seed=4)
    folder = RunFolder.create(options, "pack")
    world = StillWorld()
    watcher = Storage(options, "pack", folder, Screen(quiet=True), world, StillRecorder(world), Gate())
    with watcher.stage("scan"):
        watcher.made("frames", [frame()])
    with pytest.raises(KeyboardInterrupt), watcher.stage("detect"):
        report = json.loads((folder.path / "report.json").read_text())
        assert report["reason"] == "stopped while finding objects" and "scan" in report["timings"]
        raise KeyboardInterrupt
    watcher.close()
    assert len(read_scan(folder.scan).frames) == 1
    replay = read_recording(folder.path)
    assert [note.data["name"] for note in replay.notes if note.kind == "stage"] == ["scan", "detect"]
