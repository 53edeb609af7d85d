import json
from dataclasses import replace

import numpy as np
import pytest

from app.errors import UsageError
from app.runs.finished_run import posed_frames, read_run, support_of, tracked_frames
from perception.errors import InvalidInputError
from perception.io.object_map import write_object_map
from perception.io.recordings.trajectory import Trajectory, write_trajectory
from perception.io.scan_folder import read_scan, write_scan
from perception.types import RgbdFrame, SupportPlane, TriangleMesh


def test_a_run_without_images(tmp_path, can_at):
    write_object_map(tmp_path, [can_at(), can_at(1, 0.6)])
    run = read_run(tmp_path)
    assert [estimate.id for estimate in run.objects] == [0, 1] and run.frames == ()
    np.testing.assert_allclose(run.plane.normal, (0, 0, 1), atol=1e-9)
    assert run.plane.offset == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("where", ["scan", "."])
def test_images_are_in_the_scan_folder_or_beside_the_map(tmp_path, can_at, overhead_frame, where):
    write_object_map(tmp_path, [can_at()])
    write_scan(tmp_path / where, [overhead_frame])
    (frame,) = read_run(tmp_path).frames
    np.testing.assert_allclose(frame.T_world_camera, overhead_frame.T_world_camera, atol=1e-9)


def test_a_missing_folder_and_an_empty_map_are_refused(tmp_path):
    with pytest.raises(UsageError, match="absent is not a folder: give the run folder"):
        read_run(tmp_path / "absent")
    with pytest.raises(InvalidInputError):
        read_run(tmp_path)
    write_object_map(tmp_path, [])
    with pytest.raises(UsageError, match="holds no object: scan and reconstruct again"):
        read_run(tmp_path)


def test_images_without_a_pose_are_dropped_unless_there_is_no_other(tmp_path, overhead_frame):
    without = replace(overhead_frame, T_world_camera=None)
    write_scan(tmp_path / "mixed", [without, overhead_frame])
    assert len(posed_frames(read_scan(tmp_path / "mixed"))) == 1
    write_scan(tmp_path / "none", [without, without])
    (frame,) = posed_frames(read_scan(tmp_path / "none"))
    np.testing.assert_array_equal(frame.T_world_camera, np.eye(4))


def test_the_support_is_measured_in_images_or_taken_from_the_bases(can_at, overhead_frame):
    measured = support_of([can_at()], [overhead_frame])  # depth 0.55 m everywhere, camera at z = 0.55 m
    assert measured.offset == pytest.approx(0.0, abs=2e-3)
    lifted = can_at()
    T = np.array(lifted.T_world_object)
    T[2, 3] += 0.3
    assert support_of([replace(lifted, T_world_object=T)], []).offset == pytest.approx(0.3, abs=1e-6)
    blank = replace(overhead_frame, depth=np.zeros_like(overhead_frame.depth))
    assert isinstance(support_of([can_at()], [blank]), SupportPlane)


@pytest.fixture
def slam_run(tmp_path, overhead_frame):
    """Ten images at 10 Hz, all but number 3 tracked at x = 0.01 times their number."""
    frames = [replace(overhead_frame, time=0.1 * i, T_world_camera=None) for i in range(10)]
    write_scan(tmp_path / "sequence", frames)
    kept = [i for i in range(10) if i != 3]
    poses = []
    for i in kept:
        T = np.eye(4)
        T[0, 3] = 0.01 * i
        poses.append(T)
    run = tmp_path / "run"
    run.mkdir()
    write_trajectory(run / "trajectory.txt", Trajectory.of([0.1 * i for i in kept], poses))
    settings = {"sequence": str(tmp_path / "sequence")}
    (run / "report.json").write_text(json.dumps({"settings": settings}))
    return run


def test_tracked_images_have_their_estimated_poses(slam_run):
    frames = tracked_frames(slam_run, 0.55)
    assert [round(10 * frame.time) for frame in frames] == [0, 1, 2, 4, 5]
    for frame in frames:
        assert isinstance(frame, RgbdFrame) and frame.T_world_camera is not None
        assert frame.T_world_camera[0, 3] == pytest.approx(0.1 * frame.time, abs=1e-6)


def test_runs_of_other_commands_and_lost_sequences_have_no_tracked_images(slam_run, tmp_path):
    assert tracked_frames(tmp_path, 1.0) == ()
    (slam_run / "report.json").write_text("[]")
    assert tracked_frames(slam_run, 1.0) == ()
    (slam_run / "report.json").write_text('{"settings": {"sequence": "gone"}}')
    assert tracked_frames(slam_run, 1.0) == ()


@pytest.mark.parametrize(
    "factors", [(1, 1, 1e-9), (1e3, 1e3, 1e3), (-1, 1, 1)], ids=["flat", "huge", "inside out"]
)
def test_meshes_that_are_no_solid_objects_are_refused(tmp_path, can_at, factors):
    good = can_at()
    bad = replace(good, mesh=TriangleMesh(good.mesh.vertices * factors, good.mesh.faces))
    write_object_map(tmp_path, [bad])
    with pytest.raises(
        InvalidInputError, match=r"the mesh of can_0 .* is no solid object|can\.ply is far from its pose"
    ):
        read_run(tmp_path)
