"""Rows of the speed table run."""

import numpy as np
import pytest

from app.benchmarks import rows
from perception.inference.observation import ObjectObservation
from perception.shape.decoder import ShapeDecoder
from perception.types import CameraIntrinsics, RgbdFrame


@pytest.fixture(scope="module")
def decoder():
    return ShapeDecoder.load()


def test_rendering_and_decoding_rows_run(decoder):
    for benchmark in [*rows._rendering(decoder), *rows._decoding(decoder)]:
        benchmark.job()
        assert benchmark.name and benchmark.reference


def test_fits_are_timed_from_the_most_probable_yaw():
    blank = np.zeros((4, 4), np.float32)
    frame = RgbdFrame(
        0.0, np.zeros((4, 4, 3), np.uint8), blank, CameraIntrinsics(4, 4, 4, 4, 2, 2), np.eye(4)
    )
    seen = ObjectObservation(frame, blank > 0, None, np.array([0.2, 0.5, 0.3]))
    np.testing.assert_array_equal(rows._certain(seen), [0, 1, 0])
    assert not rows._certain(ObjectObservation(frame, blank > 0)).size
