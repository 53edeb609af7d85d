import numpy as np
import pytest

from manipulation.grasp_config import half_turn, tcp_pose
from manipulation.grasps import grasp_candidates
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
