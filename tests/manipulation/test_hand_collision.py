"""The hand as boxes: where its corners are, and what a straight approach meets."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manipulation.hand_collision import (
    HandBoxes,
    HandClearance,
    hand_is_free,
    one_per_cell,
    surface_points,
)
from manipulation.robot import GripperGeometry
from perception.types import TriangleMesh

GRIPPER = GripperGeometry()
HAND = HandBoxes.of(GRIPPER, 0.06, 0.1)
UP = np.array([0.0, 0.0, 1.0])
DOWNWARDS = np.diag([1.0, -1.0, -1.0, 1.0])  # TCP axes of a hand that points down
CLEARANCE = HandClearance(distance=0.003, approach=0.10)


def at(z):
    T = DOWNWARDS.copy()
    T[2, 3] = z
    return T


@pytest.mark.parametrize(
    "point, inside",
    [
        ((0, 0, 0), False),  # between the pads
        ((0, 0.029, 0), False),
        ((0, 0.031, 0), True),  # in a finger
        ((0, -0.031, 0), True),
        ((0, 0.030 + GRIPPER.finger_reach + 0.001, 0), False),  # beside it
        ((0.009, 0.031, 0), True),
        ((0.011, 0.031, 0), False),
        ((0, 0.031, GRIPPER.tip - 0.001), True),
        ((0, 0.031, GRIPPER.tip + 0.001), False),  # beyond the fingertip
        ((0, 0, -GRIPPER.palm + 0.001), False),
        ((0, 0, -GRIPPER.palm - 0.001), True),  # in the palm
        ((0, GRIPPER.palm_half_length + 0.001, -GRIPPER.palm - 0.01), False),
        ((GRIPPER.palm_half_width + 0.001, 0, -GRIPPER.palm - 0.01), False),
        ((0, 0, -GRIPPER.palm - 0.099), True),
        ((0, 0, -GRIPPER.palm - 0.101), False),  # behind the hand
    ],
)
def test_boxes_are_where_the_gripper_is(point, inside):
    assert HAND.contain(np.array([point], float)) == inside


def test_margins_grow_the_boxes_on_every_side():
    beside = np.array([[0.0, 0.0285, 0.0]])
    assert not HAND.contain(beside, 0.001) and HAND.contain(beside, 0.002)
    assert not HAND.sweep_contains(beside, np.zeros(3), 0.001)
    assert HAND.sweep_contains(beside, np.zeros(3), 0.002)


def test_which_points_the_hand_meets_on_its_way():
    finger = 0.03 + GRIPPER.finger_reach / 2
    points = np.array([[0.0, finger, 0.0], [0.0, finger, -0.2], [0.0, finger, -0.2 - GRIPPER.palm - 0.11]])
    points = np.vstack([points, [[0.0, 0.0, 0.0], [0.0085, finger, 0.0]]])
    back = np.array([0.0, 0.0, -0.2])
    assert HAND.swept(points, back).tolist() == [True, True, False, False, True]
    assert HAND.swept(points, back, -0.002).tolist() == [True, True, False, False, False]
    assert HAND.swept(points, np.zeros(3)).tolist() == [True, False, False, False, True]


def test_the_palm_alone_leaves_the_fingers_out():
    assert not HAND.palm.contain(np.array([[0.0, 0.035, 0.0]]))
    assert HAND.palm.contain(np.array([[0.0, 0.0, -GRIPPER.palm - 0.01]]))


coordinates = st.floats(-0.2, 0.2)


@given(st.tuples(coordinates, coordinates, coordinates), st.tuples(coordinates, coordinates, coordinates))
def test_a_sweep_is_the_union_of_its_positions(point, sweep):
    points, step = np.array([point]), np.array(sweep)
    sampled = any(HAND.contain(points - s * step, 1e-4) for s in np.linspace(0, 1, 200))
    if sampled:
        assert HAND.sweep_contains(points, step, 2e-4)
    if HAND.sweep_contains(points, step, 0.0):
        assert any(HAND.contain(points - s * step, 2e-3) for s in np.linspace(0, 1, 200))


def test_the_lowest_corner_of_a_vertical_hand_is_a_fingertip():
    assert HAND.lowest(at(0.1)) == pytest.approx(0.1 - GRIPPER.tip)
    assert hand_is_free(HAND, at(GRIPPER.tip + 1e-4), UP, np.zeros((0, 3)), CLEARANCE)
    assert not hand_is_free(HAND, at(GRIPPER.tip - 1e-4), UP, np.zeros((0, 3)), CLEARANCE)


def test_the_lowest_corner_of_a_tilted_hand_counts_every_axis():
    T = at(0.2)
    T[:3, :3] = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # approaching along x: TCP x is down
    assert HAND.lowest(T) == pytest.approx(0.2 - GRIPPER.palm_half_width)


@pytest.mark.parametrize(
    "height, free",
    [
        (0.05 + GRIPPER.tip - 0.004 - 0.02, True),  # below the fingertips
        (0.06, False),  # beside the pads
        (0.05 + 0.10, False),  # in the path of the approach
        (0.05 + GRIPPER.palm + 0.1 + 0.10 + 0.004, True),  # above everything that the hand sweeps
    ],
)
def test_obstacles_beside_and_above_the_grasp(height, free):
    obstacle = np.array([[0.0, 0.04, height]])
    assert hand_is_free(HAND, at(0.05), UP, obstacle, CLEARANCE) == free


def test_the_approach_is_along_the_retreat_direction():
    # Leaving sideways along +x sweeps the fingers over what stands at +x, and not what stands at -x.
    along_x = np.array([1.0, 0.0, 0.0])
    for side, free in ((0.05, False), (-0.05, True), (0.12, True)):
        obstacle = np.array([[side, 0.04, 0.05]])
        assert hand_is_free(HAND, at(0.05), along_x, obstacle, CLEARANCE) == free


def test_surface_points_fill_large_triangles_and_thin_small_ones():
    corner = np.array([[0.0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]])
    points = surface_points(TriangleMesh(corner, np.array([[0, 1, 2]])))
    assert np.allclose(points[:, 2], 0) and (points.sum(axis=1) <= 0.05 + 1e-12).all()
    lattice = np.random.default_rng(0).dirichlet(np.ones(3), 500) @ corner
    assert np.linalg.norm(lattice[:, None] - points, axis=2).min(axis=1).max() < 0.005
    fine = TriangleMesh(np.random.default_rng(0).uniform(0, 0.006, (3000, 3)), np.arange(3000).reshape(-1, 3))
    assert len(surface_points(fine)) <= 2**3


def test_of_each_cell_the_first_point_is_kept():
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (3000, 3)) * (1.0, 0.5, 0.1)
    kept = one_per_cell(points, 0.01)
    seen: dict[tuple[int, ...], int] = {}
    for number, point in enumerate(points):
        seen.setdefault(tuple(np.floor(point / 0.01).astype(int)), number)
    np.testing.assert_array_equal(kept, points[sorted(seen.values())])
    assert one_per_cell(points[:0], 0.01).shape == (0, 3)


def test_boxes_move_along_the_closing_direction():
    moved = HAND.moved(0.01)
    np.testing.assert_allclose(moved.low - HAND.low, np.tile((0, 0.01, 0), (3, 1)))
    np.testing.assert_allclose(moved.high - moved.low, HAND.high - HAND.low)
