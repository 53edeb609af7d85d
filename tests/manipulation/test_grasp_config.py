import numpy as np
import pytest

from manipulation.grasp_config import GraspConfig, half_turn, on_hand, tcp_pose
from manipulation.grasps import grasp_candidates
from manipulation.robot import GripperGeometry
from manipulation.standing import to_standing


def test_tcp_frame_is_right_handed_with_z_along_the_approach_and_y_along_the_closing_direction():
    approach, closing = np.array([0.0, 0.6, -0.8]), np.array([1.0, 0.0, 0.0])
    T = tcp_pose(np.array([1.0, 2.0, 3.0]), approach, closing)
    np.testing.assert_allclose(T[:3, 2], approach)
    np.testing.assert_allclose(T[:3, 1], closing)
    np.testing.assert_allclose(T[:3, 3], (1, 2, 3))
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_half_turn_swaps_the_fingers_and_keeps_the_approach(shapes):
    grasp = grasp_candidates(to_standing(shapes.estimate(1, "can", shapes.can()))).grasps[0]
    swapped = half_turn(grasp)
    np.testing.assert_allclose(swapped.T_stand_tcp[:, 2:], grasp.T_stand_tcp[:, 2:])
    np.testing.assert_allclose(swapped.T_stand_tcp[:3, :2], -grasp.T_stand_tcp[:3, :2])
    assert (swapped.opening, swapped.azimuth, swapped.score) == (grasp.opening, grasp.azimuth, grasp.score)


JAW = GripperGeometry(one_jaw=True)


def test_hands_with_two_moving_fingers_take_grasps_as_they_are(shapes):
    found = grasp_candidates(to_standing(shapes.estimate(1, "can", shapes.can())))
    assert on_hand(found, GripperGeometry()) is found


def test_the_pads_of_one_jaw_touch_the_object_where_those_of_two_fingers_do(shapes):
    """The fixed pad is at y = 0 of the TCP, the moving one at the held width; the directions are the same."""
    item = to_standing(shapes.estimate(1, "can", shapes.can(radius=0.025)))
    two, one = (grasp_candidates(item, GraspConfig(gripper=g)).grasps for g in (GripperGeometry(), JAW))
    assert len(two) == len(one)
    for middle, held in zip(two, one, strict=True):
        pads = [held.T_stand_tcp @ (0, y, 0, 1) for y in (0, held.held_width)]
        expected = [middle.T_stand_tcp @ (0, s * middle.held_width / 2, 0, 1) for s in (-1, 1)]
        np.testing.assert_allclose(pads, expected, atol=1e-12)


def test_the_fixed_pad_stands_off_and_the_moving_one_is_where_it_would_be(shapes):
    item = to_standing(shapes.estimate(1, "can", shapes.can(radius=0.025)))
    two, one = (grasp_candidates(item, GraspConfig(gripper=g)).grasps[0] for g in (GripperGeometry(), JAW))
    beside = (two.opening - two.held_width) / 2
    assert 0.003 <= one.stand_off < beside
    fixed, moving = (one.T_stand_open @ (0, y, 0, 1) for y in (0, one.opening))
    np.testing.assert_allclose(moving, two.T_stand_tcp @ (0, two.opening / 2, 0, 1), atol=1e-12)
    np.testing.assert_allclose(fixed, one.T_stand_tcp @ (0, -one.stand_off, 0, 1), atol=1e-12)
    assert one.closed_width[1] < one.opening
