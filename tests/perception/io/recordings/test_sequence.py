"""Sequences frame by frame: poses are hidden, damaged images reported, recorded detections decoded."""

import json

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.io.recordings.sequence import open_sequence, without_pose
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


def test_only_the_first_pose_of_a_scan_folder_is_kept(tmp_path, frames):
    given, masks = frames
    write_scan(tmp_path, given, [[ObjectDetection("mug", 0.9, mask, instance_id=3)] for mask in masks])
    sequence = open_sequence(tmp_path)
    read = list(sequence.frames())
    assert [number for number, _ in read] == [0, 1, 2] and len(sequence) == 3
    np.testing.assert_allclose(read[0][1].T_world_camera, given[0].T_world_camera, atol=1e-6)
    assert read[1][1].T_world_camera is None and read[2][1].T_world_camera is None
    found = sequence.detections(2, read[2][1])
    assert found is not None and found[0].category == "mug" and (found[0].mask == masks[2]).all()


def test_a_folder_with_a_pose_of_the_first_image_only(tmp_path, frames):
    given, _ = frames
    bare = [given[0], *(RgbdFrame(f.time, f.rgb, f.depth, f.intrinsics) for f in given[1:])]
    write_scan(tmp_path, bare)
    assert not read_scan(tmp_path).has_poses
    first = next(open_sequence(tmp_path).frames())[1]
    np.testing.assert_allclose(first.T_world_camera, given[0].T_world_camera, atol=1e-6)
    assert open_sequence(tmp_path).detections(0, first) is None


def test_a_damaged_image_is_yielded_as_an_error(tmp_path, frames):
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


def test_other_folders_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="is no folder"):
        open_sequence(tmp_path / "nothing")
    with pytest.raises(InvalidInputError, match="neither scene_camera"):
        open_sequence(tmp_path)


def test_without_pose_keeps_everything_else(frames):
    (first, *_), _ = frames
    bare = without_pose(first)
    assert bare.T_world_camera is None and bare.time == first.time and bare.intrinsics == first.intrinsics
    assert (bare.rgb == first.rgb).all() and (bare.depth == first.depth).all()
