"""Intrinsics in files: matrices by rows and columns, parameters, NumPy arrays, malformed files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.io.recordings.camera_files import find_camera, read_camera

K = np.array([[600.5, 0, 321], [0, 601.5, 239], [0, 0, 1]])
CAMERA = (600.5, 601.5, 321, 239)


def rows(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(f"{x:.6e}" for x in row) for row in matrix)


def padded() -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = K
    return matrix


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("cam_K.txt", rows(K)),
        ("camera-intrinsics.txt", " 6.005e+02\t 0\t 321\n0 601.5 239\n0 0 1\n"),
        ("intrinsics.txt", "600.5, 601.5, 321, 239"),
        ("intrinsic/intrinsic_depth.txt", rows(padded())),
        ("camera_intrinsic.json", json.dumps({"width": 640, "intrinsic_matrix": K.T.ravel().tolist()})),
        ("intrinsic.json", json.dumps({"intrinsic_matrix": K.tolist()})),
        (
            "intrinsics.json",
            json.dumps({"fx": 600.5, "fy": 601.5, "ppx": 321, "ppy": 239, "coeffs": [0] * 5}),
        ),
        ("color_intrinsics.json", json.dumps({"K": K.ravel().tolist(), "height": 480})),
    ],
)
def test_every_notation_gives_the_same_camera(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(content)
    camera = find_camera(tmp_path)
    assert camera is not None and camera[:4] == pytest.approx(CAMERA)
    intrinsics = camera.intrinsics(640, 480)  # in pixels of the images themselves
    assert intrinsics.fx == pytest.approx(600.5) and intrinsics.cx == pytest.approx(321)


def test_numpy_matrix(tmp_path: Path) -> None:
    np.save(tmp_path / "camK.npy", K)
    assert read_camera(tmp_path / "camK.npy")[:4] == pytest.approx(CAMERA)


def test_images_of_another_size_than_stated_are_refused(tmp_path: Path) -> None:
    (tmp_path / "intrinsic.json").write_text(
        json.dumps({"K": K.tolist(), "width": 640, "height": 480}), encoding="utf-8-sig"
    )
    camera = find_camera(tmp_path)
    assert camera is not None and camera.intrinsics(640, 480).fx == 600.5
    with pytest.raises(InvalidInputError, match="stated for images of 640x480 px, not 1280x960"):
        camera.intrinsics(1280, 960)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", [complex, str, bool])
def test_arrays_of_other_values_are_refused(tmp_path: Path, kind: type) -> None:
    np.save(tmp_path / "camK.npy", np.eye(3).astype(kind))
    with pytest.raises(InvalidInputError, match=r"camK\.npy holds no intrinsics \(its values are of type"):
        find_camera(tmp_path)


def test_the_colour_camera_is_preferred(tmp_path: Path) -> None:
    (tmp_path / "camera-intrinsics.depth.txt").write_text("400 400 300 200")
    assert find_camera(tmp_path) is not None
    (tmp_path / "camera-intrinsics.color.txt").write_text(rows(K))
    camera = find_camera(tmp_path)
    assert camera is not None and camera.fx == pytest.approx(600.5)


def test_a_folder_without_such_files_has_no_camera(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("600 600 320 240")
    assert find_camera(tmp_path) is None


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("cam_K.txt", b"600 600"),
        ("cam_K.txt", b"fx 600"),
        ("cam_K.txt", b"\xff\xfe"),
        ("cam_K.txt", b"600 600 -320 240"),
        ("cam_K.txt", b"nan 600 320 240"),
        ("cam_K.txt", b"600 30 320 0 600 240 0 0 1"),
        ("cam_K.txt", b"600 0 320 0 600 240 0 0 2"),
        ("cam_K.txt", b"600 0 320 30 600 240 0 0 1"),
        ("cam_K.txt", b"600 0 320 5 0 600 240 0 0 0 1 0 0 0 0 1"),
        ("cam_K.txt", 2**20 * b"1 "),
        ("intrinsic.json", b'{"fx": 600}'),
        ("intrinsic.json", b"[1, 2]"),
        ("intrinsic.json", b'{"intrinsic_matrix": "none"}'),
        ("camK.npy", b"no array"),
        ("cam_K.txt", b"600 0 320 50 600 240 0 0 1"),
        ("intrinsic.json", b'{"fx": 600, "fy": 600, "ppx": 320, "ppy": 240, "coeffs": [-0.4, 0.2, 0, 0, 0]}'),
        ("camK.npy", b"PK\x03\x04 an archive"),
        (
            "camK.npy",
            b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (3, 10000000000)}\n",
        ),
        ("intrinsic.json", b'{"fx": "600", "fy": 600, "cx": 320, "cy": 240}'),
        ("intrinsic.json", b'{"fx": true, "fy": 600, "cx": 320, "cy": 240}'),
        ("intrinsic.json", b'{"K": [600, 0, 320, 0, 600, 240, 0, 0, 1], "width": -640}'),
    ],
)
def test_unusable_files_are_named(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InvalidInputError, match=rf"{name} holds no intrinsics .*3x3 matrix"):
        find_camera(tmp_path)
