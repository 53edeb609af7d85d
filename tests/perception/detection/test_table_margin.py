"""Masks lose the table beside an object, and nothing of the object."""

import numpy as np
import pytest

from perception.detection.geometry import height_image
from perception.detection.table_margin import MARGIN, distance_outside, plan_image, without_table
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane

PLANE = SupportPlane()
SIZE = 121


def seen_from_above(height):
    """Image of a height field from 0.6 m above, one pixel per mm at the table."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.6
    camera = CameraIntrinsics(SIZE, SIZE, 600.0, 600.0, (SIZE - 1) / 2, (SIZE - 1) / 2)
    return RgbdFrame(0.0, np.zeros((SIZE, SIZE, 3), np.uint8), (0.6 - height).astype(np.float32), camera, T)


def trimmed(height, mask):
    frame = seen_from_above(height)
    return without_table(mask, frame.depth > 0, height_image(frame, PLANE), plan_image(frame, PLANE))


@pytest.fixture
def radius():
    across = np.arange(SIZE) - (SIZE - 1) / 2
    return np.hypot(*np.meshgrid(across, across))


def test_the_table_around_a_can_is_removed_and_the_can_is_kept(radius):
    can, mask = radius < 33, radius < 55
    kept = trimmed(np.where(can, 0.08, 0.004), mask)
    assert kept[can].all()
    assert not kept[mask & (radius > 33 / (1 - 0.08 / 0.6) + 1e3 * MARGIN + 2)].any()
    assert not kept[~mask].any()


def test_what_is_higher_than_the_table_stays(radius):
    """A handle or a spout beside the body is high enough."""
    mask = radius < 55
    assert (trimmed(np.where(radius < 33, 0.08, 0.02), mask) == mask).all()


def test_the_floor_of_a_bowl_is_below_its_wall(radius):
    mask = radius < 50
    assert (trimmed(np.where(radius < 25, 0.006, 0.05), mask) == mask).all()


def test_flat_things_and_pixels_without_depth_keep_their_masks(radius):
    mask = radius < 55
    assert (trimmed(np.where(radius < 20, 0.025, 0.004), mask) == mask).all()
    height = np.where(radius < 33, 0.08, np.where(radius > 50, 0.6, 0.004))  # depth 0: not measured
    kept = trimmed(height, mask)
    assert kept[mask & (radius > 50)].all() and not kept[(radius > 48) & (radius < 50)].any()


def test_distance_outside_a_square():
    square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0], [1.0, 1.0]])
    points = np.array([[3.0, 1.0], [1.0, -0.5], [1.0, 1.0], [1.0, 1.8], [3.0, 3.0]])
    assert distance_outside(points, square) == pytest.approx([1.0, 0.5, -1.0, -0.2, 1.0])
    assert distance_outside(points, square[::-1]) == pytest.approx([1.0, 0.5, -1.0, -0.2, 1.0])


def test_plan_coordinates_are_those_of_the_points(radius):
    frame = seen_from_above(np.zeros((SIZE, SIZE)))
    plan = plan_image(frame, PLANE)
    assert plan[60, 60] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert plan[60, 90] == pytest.approx([0.03, 0.0], abs=1e-6)
    assert plan[30, 60] == pytest.approx([0.0, 0.03], abs=1e-6)
