"""Recordings whose colour and depth images have the same number or time in their names.

| layout | colour, depth, pose |
| --- | --- |
| 7-Scenes, 3DMatch, tsdf-fusion | ``frame-000000.color.png``, ``frame-000000.depth.png``, ``frame-000000.pose.txt`` |
| RGB-D Scenes v2, YCB-Video, ClearPose | ``00000-color.png``, ``00000-depth.png`` |
| LabelFusion | ``0000000001_rgb.png``, ``0000000001_depth.png`` |
| Open3D, RealSense tools | ``color/000000.jpg``, ``depth/000000.png``; ``trajectory.log`` beside them |
| ScanNet, FoundationPose, OCID and others | ``rgb/`` or ``color/``, ``depth/``, ``pose/000000.txt`` |

Depth is 16-bit in millimetres unless stated otherwise. A pose file holds the 4x4 matrix that maps the camera
frame (x right, y down, z forward) to the world, in metres.
"""  # noqa: E501 a row of a table is one line

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from perception.errors import InvalidInputError
from perception.io.files import read_text
from perception.io.recordings.image_pairs import ImagePair, NominalCamera, read_pair
from perception.io.scan_folder import FRAME_PERIOD
from perception.types import RgbdFrame

UNITS_PER_METRE = 1000.0  # of the depth images, where nothing else is stated
COLOR_WORDS, DEPTH_WORDS, POSE_WORDS = ("color", "colour", "rgb", "image"), ("depth",), ("pose",)
COLOR_SUFFIXES, DEPTH_SUFFIXES = (".png", ".jpg", ".jpeg"), (".png",)
TRAJECTORY_LOG = "trajectory.log"
MAX_NUMBER = 1e6  # of a pose: larger ones overflow
MAX_ROTATION_ERROR = 1e-2  # of R R^T from the identity: files hold rounded numbers

Key = tuple[str, ...]  # groups of digits in a file name


@dataclass(frozen=True)
class NumberedRecording:
    """A recording of numbered images.

    Attributes:
        folder: Its folder.
        pairs: Its images by ascending number.
        camera: Its camera.
        units_per_metre: Unit of its depth images.
        poses: Pose file of each image relative to the folder, empty for images without; none without poses.
        trajectory: (n, 4, 4) camera poses of all images in one file; None without one.
    """

    folder: Path
    pairs: tuple[ImagePair, ...]
    camera: NominalCamera
    units_per_metre: float = UNITS_PER_METRE
    poses: tuple[str, ...] = ()
    trajectory: Float[np.ndarray, "n 4 4"] | None = field(default=None, repr=False)

    def read(self, index: int) -> RgbdFrame:
        """Read one frame, with its pose if the recording has poses.

        Raises:
            InvalidInputError: An image or the pose is unusable; the message names the file.
        """
        frame = read_pair(self.folder, self.pairs[index], self.camera, self.units_per_metre)
        if self.poses and not self.poses[index]:
            raise InvalidInputError(f"{self.folder / self.pairs[index].color} has no pose file")
        if self.poses:
            return replace(frame, T_world_camera=read_pose(self.folder / self.poses[index]))
        if self.trajectory is not None:
            return replace(frame, T_world_camera=self.trajectory[index])
        return frame


def find_pairs(folder: Path) -> tuple[tuple[ImagePair, ...], tuple[str, ...]]:
    """List the images that have the same number, by ascending number, and their pose files if there are any.

    A single pair may have no number.

    Images lie in the folder itself, told apart by a word in their names, or in two subfolders of such names.
    """
    names = [path.name for path in folder.iterdir() if path.is_file()]
    depths = _with_word(names, DEPTH_WORDS, DEPTH_SUFFIXES)
    color = _by_number(set(_with_word(names, COLOR_WORDS, COLOR_SUFFIXES)).difference(depths))
    depth = _by_number(depths)
    poses = _by_number(_with_word(names, POSE_WORDS, (".txt",)))
    if not color.keys() & depth.keys():
        color = _by_number(_in_subfolder(folder, COLOR_WORDS, COLOR_SUFFIXES))
        depth = _by_number(_in_subfolder(folder, DEPTH_WORDS, DEPTH_SUFFIXES))
        poses = _by_number(_in_subfolder(folder, POSE_WORDS, (".txt",)))
    common = color.keys() & depth.keys()
    keys = sorted(filter(None, common), key=_numeric) or sorted(common)
    pairs = tuple(ImagePair(k * FRAME_PERIOD, color[key], depth[key]) for k, key in enumerate(keys))
    return pairs, tuple(poses.get(key, "") for key in keys) if poses.keys() & set(keys) else ()


def is_numbered_recording(folder: Path) -> bool:
    """Return whether the folder has a colour and a depth image of the same number."""
    return bool(find_pairs(folder)[0])


def open_numbered(
    folder: Path, camera: NominalCamera | None, units_per_metre: float = UNITS_PER_METRE
) -> NumberedRecording:
    """List the images of a recording and find its poses.

    Raises:
        InvalidInputError: There are no images, no camera, or ``trajectory.log`` is malformed or of another
            length.
    """
    pairs, poses = find_pairs(folder)
    if not pairs:
        raise InvalidInputError(f"{folder} has no colour and depth image of the same number")
    if camera is None:
        raise InvalidInputError(
            f"{folder} does not state its camera: give --camera fx,fy,cx,cy in pixels of its images, or add "
            "cam_K.txt with the 3x3 matrix"
        )
    path = folder / TRAJECTORY_LOG
    trajectory = read_trajectory_log(path) if not poses and path.is_file() else None
    if trajectory is not None and len(trajectory) != len(pairs):
        raise InvalidInputError(
            f"{path} has {len(trajectory)} poses for {len(pairs)} images: it needs one each"
        )
    return NumberedRecording(folder, pairs, camera, units_per_metre, poses, trajectory)


def read_pose(path: Path) -> Float[np.ndarray, "4 4"]:
    """Read a camera pose: a 4x4 matrix in a text file.

    Raises:
        InvalidInputError: The file is unreadable or holds no rigid transform, such as the infinite matrices
            by which ScanNet marks images whose camera was lost.
    """
    try:
        return _rigid(read_text(path).split())
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{path} holds no camera pose ({error}): 4x4 numbers in metres") from None


def read_trajectory_log(path: Path) -> Float[np.ndarray, "n 4 4"]:
    """Read a trajectory as Open3D writes it: for each image one line of numbers and the 4x4 pose.

    Raises:
        InvalidInputError: The file is unreadable, or an entry is no rigid transform.
    """
    try:
        lines = [line.split() for line in read_text(path).splitlines() if line.strip()]
        return np.array([_logged_pose(k // 5, lines[k : k + 5]) for k in range(0, len(lines), 5)])
    except (OSError, ValueError) as error:
        raise InvalidInputError(
            f"{path} is no trajectory ({error}): for each image a line of numbers and a 4x4 matrix"
        ) from None


def _logged_pose(index: int, lines: list[list[str]]) -> Float[np.ndarray, "4 4"]:
    """Return the pose in a line of integers and four lines of numbers."""
    try:
        for word in lines[0]:
            int(word)
        return _rigid([word for line in lines[1:] for word in line])
    except ValueError as error:
        raise ValueError(f"pose {index}: {error}") from None


def _rigid(words: Iterable[str]) -> Float[np.ndarray, "4 4"]:
    """Return the nearest rigid transform to 16 numbers by rows; raises ValueError if it is not near."""
    numbers = np.array([float(word) for word in words])
    if numbers.size != 16:
        raise ValueError(f"{numbers.size} numbers instead of 16")
    T = numbers.reshape(4, 4)
    if not (np.abs(T) <= MAX_NUMBER).all():  # NaN fails as well
        raise ValueError(f"it is not finite, or above {MAX_NUMBER:g}")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > MAX_ROTATION_ERROR or np.linalg.det(R) < 0:
        raise ValueError("its rotation is not orthonormal")
    if not np.allclose(T[3], (0, 0, 0, 1), atol=1e-3):
        raise ValueError("its fourth row is not 0 0 0 1")
    u, _, vt = np.linalg.svd(R)
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = u @ vt, T[:3, 3]
    return rigid


def _with_word(names: Iterable[str], words: tuple[str, ...], suffixes: tuple[str, ...]) -> list[str]:
    """Return the names with one of the words as a whole word, and one of the suffixes."""
    pattern = re.compile(r"(^|[^a-z])(" + "|".join(words) + r")s?([^a-z]|$)")
    return [name for name in names if pattern.search(name.lower()) and name.lower().endswith(suffixes)]


def _in_subfolder(folder: Path, words: tuple[str, ...], suffixes: tuple[str, ...]) -> list[str]:
    """Return the files of the first subfolder named by one of the words, in their order."""
    for word in words:
        for name in (word, f"{word}s"):
            if (folder / name).is_dir():
                return [
                    f"{name}/{path.name}"
                    for path in (folder / name).iterdir()
                    if path.name.lower().endswith(suffixes)
                ]
    return []


def _by_number(names: Iterable[str]) -> Mapping[Key, str]:
    """Return the names by the groups of digits in the file names, the shortest name of each number."""
    order = sorted(names, key=lambda name: (-len(name), name))
    return {tuple(re.findall(r"\d+", Path(name).stem)): name for name in order}


def _numeric(key: Key) -> tuple[int, ...]:
    return tuple(map(int, key))
