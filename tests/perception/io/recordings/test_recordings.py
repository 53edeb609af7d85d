"""Trajectories on disk and sequences frame by frame: scan folders and TUM recordings, whole and damaged."""

import json

import numpy as np
import pytest
from PIL import Image

from perception.errors import InvalidInputError
from perception.geometry import se3_exp
from perception.io.recordings.sequence import open_sequence
from perception.io.recordings.trajectory import Trajectory, read_trajectory, write_trajectory
from perception.io.recordings.tum import CAMERAS, DEFAULT_CAMERA, open_tum
from perception.io.scan_folder import read_scan, write_scan
from perception.types import ObjectDetection, RgbdFrame


@pytest.fixture
def frames(scenes):
    poses = [scenes.orbit((0, 0, 0), 0.5, 45, 10 * k) for k in range(3)]
    shown = [scenes.render([scenes.Solid(0, 0, 0.08, radius=0.04)], T, size=(64, 48)) for T in poses]
    frames = [
        RgbdFrame(0.1 * k, s.frame.rgb, s.frame.depth, s.frame.intrinsics, s.frame.T_world_camera)
        for k, s in enumerate(shown)
    ]
    return frames, [s.instances == 0 for s in shown]


def test_trajectory_comes_back(tmp_path):
    rng = np.random.default_rng(0)
    poses = [se3_exp(rng.normal(size=6)) for _ in range(5)]
    write_trajectory(tmp_path / "t.txt", Trajectory.of([0.0, 0.5, 1.0, 1.5, 2.0], poses))
    back = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(back.Ts_world_camera, poses, atol=1e-7)
    np.testing.assert_allclose(back.times, [0, 0.5, 1, 1.5, 2])


def test_a_line_that_is_no_pose_is_named(tmp_path):
    (tmp_path / "t.txt").write_text("# comment\n0 0 0 0 0 0 0 1\n1 2 3\n")
    with pytest.raises(InvalidInputError, match=r"t\.txt, line 3 is no pose"):
        read_trajectory(tmp_path / "t.txt")


def test_scan_folder_keeps_only_the_first_pose(tmp_path, frames):
    given, masks = frames
    write_scan(tmp_path, given, [[ObjectDetection("mug", 0.9, mask, instance_id=3)] for mask in masks])
    sequence = open_sequence(tmp_path)
    read = list(sequence.frames())
    assert [number for number, _ in read] == [0, 1, 2] and len(sequence) == 3
    np.testing.assert_allclose(read[0][1].T_world_camera, given[0].T_world_camera, atol=1e-6)
    assert read[1][1].T_world_camera is None and read[2][1].T_world_camera is None
    found = sequence.detections(2, read[2][1])
    assert found is not None and found[0].category == "mug" and (found[0].mask == masks[2]).all()


def test_a_folder_with_the_first_pose_alone_has_no_poses_for_others(tmp_path, frames):
    given, _ = frames
    bare = [given[0], *(RgbdFrame(f.time, f.rgb, f.depth, f.intrinsics) for f in given[1:])]
    write_scan(tmp_path, bare)
    assert not read_scan(tmp_path).has_poses
    first = next(open_sequence(tmp_path).frames())[1]
    np.testing.assert_allclose(first.T_world_camera, given[0].T_world_camera, atol=1e-6)
    assert open_sequence(tmp_path).detections(0, first) is None


def test_a_damaged_image_is_told_and_passed_over(tmp_path, frames):
    write_scan(tmp_path, frames[0])
    (tmp_path / "depth" / "000001.png").write_bytes(b"no image")
    kinds = [type(frame) for _, frame in open_sequence(tmp_path).frames()]
    assert kinds == [RgbdFrame, InvalidInputError, RgbdFrame]


def test_bad_detections_name_their_entry(tmp_path, frames):
    given, masks = frames
    write_scan(tmp_path, given, [[ObjectDetection("mug", 0.9, mask)] for mask in masks])
    path = tmp_path / "detections.json"
    entries = json.loads(path.read_text())
    entries[1]["category_name"] = "dragon"
    path.write_text(json.dumps(entries))
    sequence = open_sequence(tmp_path)
    assert sequence.detections(0, given[0])
    with pytest.raises(InvalidInputError, match=r"entry 1 .image 1.*'dragon'"):
        sequence.detections(1, given[1])


@pytest.fixture
def tum(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg2_desk"
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for k in range(3):
        Image.fromarray(np.full((48, 64, 3), 10 * k, np.uint8)).save(folder / "rgb" / f"{k}.png")
        Image.fromarray(np.full((48, 64), 5000 * (k + 1), np.uint16)).save(folder / "depth" / f"{k}.png")
    rgb = "\n".join(f"{k + 0.005} rgb/{k}.png" for k in range(3))
    depth = "\n".join(f"{k + (0.5 if k == 1 else 0)} depth/{k}.png" for k in range(3))
    (folder / "rgb.txt").write_text(f"# colour\n{rgb}\n")
    (folder / "depth.txt").write_text(f"# depth\n{depth}\n")
    return folder


def test_tum_images_are_paired_by_time(tum):
    sequence = open_sequence(tum)
    frames = [frame for _, frame in sequence.frames()]
    assert [frame.time for frame in frames] == [
        0,
        2,
    ]  # the second depth image is half a second from any colour
    assert frames[1].depth[0, 0] == pytest.approx(3.0) and frames[1].rgb[0, 0, 0] == 20
    fx, _, cx, _ = np.array(CAMERAS["freiburg2"]) / 10  # the images here are a tenth as wide
    assert frames[0].intrinsics.fx == pytest.approx(fx) and frames[0].intrinsics.cx == pytest.approx(cx)
    assert sequence.detections(0, frames[0]) is None


def test_tum_intrinsics_can_be_given(tum):
    (tum / "intrinsics.txt").write_text("600 601 320 240")
    assert open_tum(tum).camera == (600, 601, 320, 240)
    (tum / "intrinsics.txt").write_text("600 601")
    with pytest.raises(InvalidInputError, match="four numbers"):
        open_tum(tum)


def test_an_unknown_tum_camera_gets_the_default(tum):
    assert open_tum(tum.rename(tum.with_name("office"))).camera == DEFAULT_CAMERA


def test_what_is_no_sequence_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="is no folder"):
        open_sequence(tmp_path / "nothing")
    with pytest.raises(InvalidInputError, match="neither scene_camera"):
        open_sequence(tmp_path)
