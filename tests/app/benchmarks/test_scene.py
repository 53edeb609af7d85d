"""Input of the benchmarks."""

import numpy as np
import pytest

from app.benchmarks import scene
from app.benchmarks.scene import as_captured, prepare, square_view
from perception.depth_cleaning import clean_frame
from perception.errors import InvalidInputError
from perception.types import CameraIntrinsics, RgbdFrame


def test_the_square_view_looks_down_at_the_object():
    rays, A = square_view(side=5, samples=7)
    assert rays.directions.shape == (25, 3) and rays.samples == 7
    middle = rays.directions[12]  # half a metre along the middle ray lies the object's centre
    np.testing.assert_allclose(A[0, :, :3] @ (0.5 * middle) + A[0, :, 3], 0, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.linalg.det(A[0, :, :3])), (1.8 / 0.1) ** 3)
    np.testing.assert_array_equal(rays.depth_range, [[0.4, 0.6]])


def test_scans_without_objects_cannot_be_timed(monkeypatch, tmp_path):
    class Nothing:
        frames, detector, decoder, per_frame = (), None, None, ()

    for name in ("read_scan", "load_perception", "detect"):
        monkeypatch.setattr(scene, name, lambda *_: Nothing)
    monkeypatch.setattr(scene, "gather_instances", lambda *_: [])
    with pytest.raises(InvalidInputError, match=r"no object is found in .*scan: nothing to time"):
        prepare(tmp_path / "scan", 0, "cpu")


def test_nothing_is_kept_for_images_that_are_timed_again():
    camera = CameraIntrinsics(8, 6, 8.0, 8.0, 3.5, 2.5)
    frame = RgbdFrame(0.0, np.zeros((6, 8, 3), np.uint8), np.ones((6, 8), np.float32), camera)
    cleaned = clean_frame(frame)
    (again,) = as_captured([frame])
    np.testing.assert_array_equal(again.depth, frame.depth)
    assert clean_frame(frame) is cleaned and clean_frame(again) is not cleaned
