"""The first images are reconstructed while others are taken, and no others."""

import threading

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from perception.early import EarlyReconstruction
from perception.errors import PerceptionError
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame, TriangleMesh

CAMERA = CameraIntrinsics(4, 3, 4.0, 4.0, 1.5, 1.0)
MUG = ObjectEstimate(
    0, "mug", np.zeros(16), np.eye(4), np.ones(3), TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))
)


def image(time):
    return RgbdFrame(time, np.zeros((3, 4, 3), np.uint8), np.ones((3, 4), np.float32), CAMERA)


def test_objects_are_ready_before_the_last_image_is_taken():
    seen, ready = [], threading.Event()

    def reconstruct(frames):
        seen.append([frame.time for frame in frames])
        ready.set()
        return [MUG]

    with EarlyReconstruction(reconstruct, after=2) as early:
        early.add(image(0.0))
        assert not ready.wait(0.05)
        early.add(image(1.0))
        assert ready.wait(10.0)  # the scan goes on only now
        early.add(image(2.0))
        assert early.estimates() == (MUG,) and seen == [[0.0, 1.0]]


@pytest.mark.parametrize("after", [0, 4])
def test_too_few_images_give_no_objects(after):
    with EarlyReconstruction(lambda frames: pytest.fail("started"), after) as early:
        for time in range(3):
            early.add(image(float(time)))
        assert early.estimates() == ()


def test_scenes_without_a_table_give_no_objects_and_defects_are_raised():
    def fails(error):
        def reconstruct(frames):
            raise error

        return reconstruct

    with EarlyReconstruction(fails(PerceptionError("no plane")), 1) as early:
        early.add(image(0.0))
        assert early.estimates() == ()
    with EarlyReconstruction(fails(ZeroDivisionError()), 1) as early:
        early.add(image(0.0))
        with pytest.raises(ZeroDivisionError):
            early.estimates()


def test_libraries_run_on_one_thread_in_both_threads_until_it_is_closed():
    def pools():
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    before, inside = pools(), []
    with EarlyReconstruction(lambda frames: inside.append(pools()) or [], 1) as early:
        early.add(image(0.0))
        early.estimates()
        assert pools() == {1} and inside == [{1}]
    assert pools() == before


def test_an_interrupted_scan_ends_the_thread():
    release = threading.Event()
    early = EarlyReconstruction(lambda frames: [MUG] if release.wait(10.0) else [], 1)
    with pytest.raises(KeyboardInterrupt), early:
        early.add(image(0.0))
        release.set()
        raise KeyboardInterrupt
    assert not any(thread.name.startswith("early") for thread in threading.enumerate())
