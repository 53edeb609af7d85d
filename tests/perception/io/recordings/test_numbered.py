"""Recordings of numbered images: layouts, order, poses, trajectories, unusable poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from perception.errors import InvalidInputError
from perception.io.recordings.image_pairs import NominalCamera
from perception.io.recordings.numbered import (
    find_pairs,
    is_numbered_recording,
    open_numbered,
    read_pose,
    read_trajectory_log,
)

CAMERA = NominalCamera(60.0, 60.0, 32.0, 24.0, 0)


def save(path: Path, value: int) -> None:
    """Write a colour image, or a depth image if the name says so, of one value."""
    path.parent.mkdir(parents=True, exist_ok=True)
    depth = "depth" in path.as_posix().rsplit("test_", 1)[-1].split("/", 1)[-1]
    image = np.full((48, 64), 100 * value, np.uint16) if depth else np.full((48, 64, 3), value, np.uint8)
    Image.fromarray(image).save(path)


def pose(k: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", (0.1 * k, 0.2, 0.3)).as_matrix()
    T[:3, 3] = k, 2, 3
    return T


LAYOUTS = {
    "7-Scenes": ("frame-{:06d}.color.png", "frame-{:06d}.depth.png", "frame-{:06d}.pose.txt"),
    "RGB-D Scenes": ("{:05d}-color.png", "{:05d}-depth.png", "{:05d}-pose.txt"),
    "LabelFusion": ("{:010d}_rgb.png", "{:010d}_depth.png", "{:010d}_pose.txt"),
    "ScanNet": ("color/{}.jpg", "depth/{}.png", "pose/{}.txt"),
    "RealSense tools": ("rgb/rgb{:05d}.png", "depths/depth{:05d}.png", "poses/{:05d}.txt"),
    "depth_image": ("rgb_image_{}.png", "depth_image_{}.png", "pose_{}.txt"),
    "OCID": ("rgb/result_2018-08-23-10-{:02d}-1.png", "depth/result_2018-08-23-10-{:02d}-1.png", ""),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts(tmp_path: Path, layout: str) -> None:
    color, depth, poses = LAYOUTS[layout]
    folder = tmp_path / "recording"
    for k in (9, 10, 11):  # 10 precedes 9 in the order of text
        save(folder / color.format(k), k)
        save(folder / depth.format(k), k)
        if poses:
            (folder / poses.format(k)).parent.mkdir(exist_ok=True)
            np.savetxt(folder / poses.format(k), pose(k), fmt="%.7e")
    save(folder / color.format(12), 12)  # without depth
    (folder / "frame-000009.segm.png").write_bytes(b"")
    assert is_numbered_recording(folder)
    recording = open_numbered(folder, CAMERA)
    frames = [recording.read(k) for k in range(len(recording.pairs))]
    assert [int(frame.rgb[0, 0, 0]) for frame in frames] == pytest.approx([9, 10, 11], abs=1)
    assert [float(frame.depth[0, 0]) for frame in frames] == pytest.approx([0.9, 1.0, 1.1])
    assert frames[1].time == pytest.approx(1 / 30) and frames[0].intrinsics.fx == 60
    for k, frame in zip((9, 10, 11), frames):
        if poses:
            np.testing.assert_allclose(frame.T_world_camera, pose(k), atol=1e-6)
        else:
            assert frame.T_world_camera is None


def test_a_single_pair_needs_no_number(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    save(folder / "color.png", 7)
    save(folder / "depth.png", 7)
    assert open_numbered(folder, CAMERA).read(0).depth[0, 0] == pytest.approx(0.7)
    save(folder / "color_1.png", 8)
    save(folder / "depth_1.png", 8)
    pairs, _ = find_pairs(folder)
    assert [pair.color for pair in pairs] == ["color_1.png"]


def test_the_unit_of_depth(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    save(folder / "rgb/1.png", 5)
    save(folder / "depth/1.png", 5)
    assert open_numbered(folder, CAMERA, 5000.0).read(0).depth.max() == pytest.approx(0.1)


def test_images_without_a_usable_pose_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    for k in range(3):
        save(folder / f"color/{k}.jpg", k)
        save(folder / f"depth/{k}.png", k)
    (folder / "pose").mkdir()
    np.savetxt(folder / "pose/0.txt", pose(0))
    np.savetxt(folder / "pose/1.txt", np.full((4, 4), -np.inf))
    recording = open_numbered(folder, CAMERA)
    assert recording.read(0).T_world_camera is not None
    with pytest.raises(
        InvalidInputError, match=r"pose/1\.txt holds no camera pose \(it is not finite, or above 1e\+06\)"
    ):
        recording.read(1)
    with pytest.raises(InvalidInputError, match=r"color/2\.jpg has no pose file"):
        recording.read(2)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("1 2 3", "3 numbers instead of 16"),
        ("a " * 16, "could not convert"),
        ("2 " * 16, "not orthonormal"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0.1 0.2 0.5 1", "fourth row"),
        ("1e300 " * 16, "above 1e\\+06"),
    ],
)
def test_malformed_poses(tmp_path: Path, content: str, words: str) -> None:
    (tmp_path / "p.txt").write_text(content)
    with pytest.raises(InvalidInputError, match=words):
        read_pose(tmp_path / "p.txt")


def test_rounded_rotations_are_made_orthonormal(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "p.txt", pose(1), fmt="%.3f")
    R = read_pose(tmp_path / "p.txt")[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_trajectory_log(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    for k in range(2):
        save(folder / f"color/{k}.jpg", k)
        save(folder / f"depth/{k}.png", k)
    blocks = [f"{k} {k} {k + 1}\n" + "\n".join(" ".join(map(str, row)) for row in pose(k)) for k in range(2)]
    (folder / "trajectory.log").write_text("\n".join(blocks) + "\n\n")
    np.testing.assert_allclose(open_numbered(folder, CAMERA).read(1).T_world_camera, pose(1), atol=1e-9)
    (folder / "trajectory.log").write_text(blocks[0])
    with pytest.raises(InvalidInputError, match="has 1 poses for 2 images"):
        open_numbered(folder, CAMERA)
    (folder / "trajectory.log").write_text("0 0 1\n1 0 0 0\n")
    with pytest.raises(InvalidInputError, match=r"trajectory\.log is no trajectory \(pose 0: 4 numbers"):
        read_trajectory_log(folder / "trajectory.log")
    (folder / "trajectory.log").write_text("\n".join(block.partition("\n")[2] for block in blocks))
    with pytest.raises(InvalidInputError, match=r"pose 0: invalid literal for int"):  # no line of numbers
        read_trajectory_log(folder / "trajectory.log")


def test_folders_without_pairs_or_camera(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    save(folder / "rgb/1.png", 5)
    save(folder / "depth/2.png", 5)
    assert not is_numbered_recording(folder)
    with pytest.raises(InvalidInputError, match="no colour and depth image of the same number"):
        open_numbered(folder, CAMERA)
    save(folder / "depth/1.png", 5)
    with pytest.raises(InvalidInputError, match=r"give --camera fx,fy,cx,cy .* or add cam_K\.txt"):
        open_numbered(folder, None)
