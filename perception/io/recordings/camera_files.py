"""Camera intrinsics from the files in which recordings state them.

| file | content |
| --- | --- |
| ``camera-intrinsics.txt``, ``cam_K.txt``, ``intrinsics.txt`` and other texts of such names | 3x3 or 4x4 matrix, or ``fx fy cx cy`` |
| ``intrinsic/intrinsic_color.txt`` (ScanNet) | 4x4 matrix |
| ``camK.npy`` (GraspNet-1Billion) | 3x3 matrix |
| ``camera_intrinsic.json``, ``intrinsic.json`` (Open3D, librealsense) | ``intrinsic_matrix`` by columns, ``K`` or ``cam_K`` by rows, or ``fx, fy, cx, cy`` (or ``ppx, ppy``) |
"""  # noqa: E501 a row of a table is one line

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InvalidInputError
from perception.io.arrays import numbers_of, parse_array
from perception.io.files import read_bytes, read_json
from perception.io.recordings.image_pairs import NominalCamera

PATTERNS = (
    "*intrinsic*.txt",
    "*intrinsic*.json",
    "cam_K.txt",
    "camK.npy",
    "K.txt",
    "intrinsic*/*intrinsic*color*.txt",
    "intrinsic*/*intrinsic*depth*.txt",
)
MAX_BYTES = 2**20
DISTORTION = ("coeffs", "distortion", "distortion_coefficients", "dist_coeffs")  # keys in JSON objects
MAX_SKEW = 1e-3  # of the focal length: less than a pixel
ORIGINAL_WIDTH = 0.0  # the files refer to the recording's own images


def find_camera(folder: Path) -> NominalCamera | None:
    """Read the intrinsics that a recording states; None if it has no such file.

    Of several files that of the colour camera is read.

    Raises:
        InvalidInputError: The file holds no intrinsics.
    """
    paths = [path for pattern in PATTERNS for path in sorted(folder.glob(pattern)) if path.is_file()]
    if not paths:
        return None
    return read_camera(next((path for path in paths if "color" in path.name.lower()), paths[0]))


def read_camera(path: Path) -> NominalCamera:
    """Read the intrinsics in a text, JSON or NumPy file.

    Raises:
        InvalidInputError: The file is unreadable, or holds no intrinsics of a pinhole camera.
    """
    try:
        size = (0, 0)
        if path.suffix == ".json":
            content = read_json(path, "it states the intrinsics")
            numbers, size = _from_json(content), _stated_size(content)
        elif path.suffix == ".npy":
            numbers = parse_array(read_bytes(path, MAX_BYTES), "it")
            if numbers.dtype.kind not in "iuf":
                raise ValueError(f"its values are of type {numbers.dtype}")
        else:
            numbers = np.array([float(word) for word in _text(path).replace(",", " ").split()])
        fx, fy, cx, cy = _parameters(numbers)
    except (OSError, ValueError, TypeError, KeyError, EOFError) as error:
        raise InvalidInputError(
            f"{path} holds no intrinsics ({error}): give a 3x3 matrix, or fx fy cx cy in pixels"
        ) from None
    return NominalCamera(fx, fy, cx, cy, ORIGINAL_WIDTH, size)


def _text(path: Path) -> str:
    return read_bytes(path, MAX_BYTES).decode("utf-8-sig")


def _from_json(content: Any) -> np.ndarray:
    """Return the numbers of a JSON object: a matrix by rows, or four parameters."""
    if not isinstance(content, Mapping):
        raise ValueError("no JSON object")
    for key in DISTORTION:
        if isinstance(content.get(key), list) and numbers_of(content[key]).any():
            raise ValueError(f"{key} states a distortion; undistort the images and remove it")
    if "intrinsic_matrix" in content:  # by columns, as Open3D and Eigen store it
        numbers = numbers_of(content["intrinsic_matrix"])
        return numbers.reshape(3, 3).T if numbers.ndim == 1 else numbers
    for key in ("K", "k", "cam_K", "camera_matrix"):
        if key in content:
            return numbers_of(content[key])
    centre = ("cx", "cy") if "cx" in content else ("ppx", "ppy")
    return numbers_of([content[key] for key in ("fx", "fy", *centre)])


def _stated_size(content: Mapping[str, Any]) -> tuple[int, int]:
    """Return width and height of the images that a JSON object states; 0 for what it does not state."""
    size = (content.get("width", 0), content.get("height", 0))
    if not all(type(side) is int and side >= 0 for side in size):
        raise ValueError(f"width and height {size} are no numbers of pixels")
    return size


def _parameters(numbers: np.ndarray) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a matrix by rows or of the four themselves."""
    if numbers.size in (9, 16):
        side = 3 if numbers.size == 9 else 4
        matrix = numbers.reshape(side, side)
        for skew in (matrix[0, 1], matrix[1, 0]):
            if abs(skew) > MAX_SKEW * abs(matrix[0, 0]):
                raise ValueError(f"the skew {skew:g} is not zero; undistort and rectify the images")
        if not np.allclose(matrix[2, :3], (0, 0, 1)):
            raise ValueError("the third row is not 0 0 1")
        if side == 4 and not (np.allclose(matrix[:, 3], (0, 0, 0, 1)) and np.allclose(matrix[3, :3], 0)):
            raise ValueError("the fourth row and column are not 0 0 0 1")
        numbers = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    if numbers.size != 4:
        raise ValueError(f"{numbers.size} numbers")
    fx, fy, cx, cy = map(float, numbers.ravel())
    if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy, cx, cy) > 0):
        raise ValueError(f"fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} are not all positive")
    return fx, fy, cx, cy
