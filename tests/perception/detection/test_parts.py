"""A side of a carton continues in its other side; a can beside it does not."""

import numpy as np
import pytest

from perception.detection.left_out import LeftOut
from perception.detection.parts import VIEWS, continued_share, parts_of_things
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame

DEPTH = np.full((120, 160), 0.9, np.float32)


def rectangle(top, bottom, left, right):
    mask = np.zeros(DEPTH.shape, bool)
    mask[top:bottom, left:right] = True
    return mask


def test_two_sides_of_a_carton_share_an_edge():
    left, right = rectangle(20, 100, 30, 60), rectangle(20, 100, 60, 110)
    columns = np.arange(160)
    depth = np.broadcast_to(0.7 + 0.001 * np.abs(columns - 60), DEPTH.shape).astype(np.float32)
    outline = 2 * (80 + 30) - 4
    assert continued_share(left, right, depth) == pytest.approx(80 / outline, abs=0.04)


def test_an_object_before_or_beside_a_carton_does_not_go_on():
    can, carton = rectangle(40, 100, 30, 60), rectangle(20, 100, 60, 110)
    before = np.where(can, 0.6, DEPTH).astype(np.float32)
    assert continued_share(can, carton, before) == 0.0
    assert continued_share(can, rectangle(20, 100, 80, 110), DEPTH) == 0.0


def test_missing_depth_is_no_continuation():
    left, right = rectangle(20, 100, 30, 60), rectangle(20, 100, 60, 110)
    assert continued_share(left, right, np.where(right, 0, DEPTH).astype(np.float32)) == 0.0


def test_noise_grows_with_the_distance():
    left, right = rectangle(20, 100, 30, 60), rectangle(20, 100, 60, 110)
    step = np.where(right, 0.008, 0.0).astype(np.float32)
    assert continued_share(left, right, np.float32(0.4) + step) < 0.05
    assert continued_share(left, right, np.float32(1.4) + step) > 0.3


def seen(depth):
    camera = CameraIntrinsics(160, 120, 200.0, 200.0, 79.5, 59.5)
    return RgbdFrame(0.0, np.zeros((120, 160, 3), np.uint8), depth.astype(np.float32), camera, np.eye(4))


@pytest.mark.parametrize(
    ("joined", "views", "is_part"), [(VIEWS, VIEWS, True), (1, VIEWS, False), (VIEWS - 1, VIEWS - 1, False)]
)
def test_what_goes_on_in_a_thing_in_most_views_is_a_part_of_it(joined, views, is_part):
    """The shaft of a boot, with the foot at the same depth; elsewhere something of no class is behind it."""
    shaft, foot = rectangle(20, 60, 30, 60), rectangle(60, 100, 30, 100)
    frames = [seen(DEPTH if k < joined else np.where(shaft, 0.7, DEPTH)) for k in range(views)]
    rows = [[ObjectDetection("mug", 0.99, shaft, instance_id=4)]] * views
    cans = [[ObjectDetection("can", 0.99, shaft, instance_id=4)]] * views
    left_out = [LeftOut(foot, "of none of the classes", frame=k) for k in range(views)]
    assert parts_of_things(frames, rows, left_out) == ({4} if is_part else set())
    assert parts_of_things(frames, cans, left_out) == set()
    table = [LeftOut(foot, "does not rise above the support surface", frame=k) for k in range(views)]
    assert parts_of_things(frames, rows, table) == set()
    assert parts_of_things(frames, [[]] * views, left_out) == set()
