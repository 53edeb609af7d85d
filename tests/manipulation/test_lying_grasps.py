import numpy as np
import pytest
import trimesh

from manipulation.grasp_config import half_turn
from manipulation.lying_grasps import HAND_HEIGHT, is_upside_down, lies, lying_grasps
from manipulation.standing import to_standing
from perception.geometry import pose_from_yaw

UP = np.array([0.0, 0.0, 1.0])


def lying_pose(radius, azimuth=0.4, roll=0.9):
    """A pose with the object's axis horizontal along ``azimuth``, rolled about its axis."""
    on_side = np.eye(4)
    on_side[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    T = pose_from_yaw(azimuth, np.array([0.5, -0.2, radius]))
    return T @ on_side @ pose_from_yaw(roll, np.zeros(3))


@pytest.fixture
def can(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(radius=0.03, height=0.14)))


def test_orientations():
    assert not lies(np.eye(4)) and lies(lying_pose(0.03)) and not is_upside_down(lying_pose(0.03))
    assert lies(np.diag([1.0, -1, -1, 1])) and is_upside_down(np.diag([1.0, -1, -1, 1]))


def test_grasps_close_across_the_axis_from_above_with_the_camera_towards_the_top(can):
    T_world_stand = lying_pose(0.03)
    found = lying_grasps(can, T_world_stand)
    assert found.grasps and found.rejected["too near to the base to be set upright"] > 0
    axis = T_world_stand[:3, 2]
    for grasp in found.grasps[: len(found.grasps) // 2]:
        T_world_tcp = T_world_stand @ grasp.T_stand_tcp
        np.testing.assert_allclose(T_world_tcp[:3, 2], -UP, atol=1e-9)
        np.testing.assert_allclose(T_world_tcp[:3, 0], axis, atol=1e-9)
        np.testing.assert_allclose(T_world_stand[:3, :3] @ grasp.away, UP, atol=1e-9)
        assert grasp.held_width == pytest.approx(0.06, abs=1e-3)
        assert grasp.T_stand_tcp[2, 3] >= HAND_HEIGHT
        assert T_world_tcp[2, 3] == pytest.approx(0.03, abs=1e-3)


def test_to_be_moved_as_it_lies_it_is_also_held_near_its_base(can):
    held = lying_grasps(can, lying_pose(0.03), least_height=0.0)
    assert min(grasp.T_stand_tcp[2, 3] for grasp in held.grasps) == pytest.approx(0.03)
    assert not held.rejected["too near to the base to be set upright"]


def test_set_upright_the_hand_is_horizontal_with_the_camera_above(can):
    grasps = lying_grasps(can, lying_pose(0.03)).grasps
    for grasp in grasps[: len(grasps) // 2]:
        np.testing.assert_allclose(grasp.T_stand_tcp[:3, 0], UP, atol=1e-9)
        assert grasp.T_stand_tcp[2, 2] == pytest.approx(0.0, abs=1e-9)


def test_the_hand_may_also_hold_the_other_way_round(can):
    """After all grasps with the camera above: at the same places, with the fingers swapped."""
    grasps = lying_grasps(can, lying_pose(0.03)).grasps
    first, second = grasps[: len(grasps) // 2], grasps[len(grasps) // 2 :]
    for grasp, other in zip(first, second, strict=True):
        np.testing.assert_allclose(other.T_stand_tcp, half_turn(grasp).T_stand_tcp)
        assert other.score < min(g.score for g in first)


def test_places_with_parallel_sides_come_before_tapered_ones(shapes):
    """A cone from 6 cm above the base on, with its middle where the object is usually held."""
    outline = np.array([(0, 0), (0.034, 0), (0.034, 0.06), (0.014, 0.12), (0.014, 0.18), (0, 0.18)])
    mesh = trimesh.creation.revolve(outline, sections=48)
    item = to_standing(shapes.estimate(1, "bottle", mesh))
    best = lying_grasps(item, lying_pose(0.034)).grasps[0]
    assert best.T_stand_tcp[2, 3] > 0.12 or best.T_stand_tcp[2, 3] < 0.06


@pytest.mark.parametrize(("radius", "middle"), [(0.030, True), (0.038, False)])
def test_where_the_middle_nearly_fills_the_hand_narrower_places_come_first(shapes, radius, middle):
    """Of a body that narrows from 0.12 m above its base on."""
    profile = [(0, 0), (radius, 0), (radius, 0.12), (radius - 0.007, 0.14), (radius - 0.007, 0.2), (0, 0.2)]
    item = to_standing(shapes.estimate(1, "bottle", trimesh.creation.revolve(np.array(profile))))
    best = lying_grasps(item, lying_pose(radius)).grasps[0]
    assert (best.held_width > 2 * radius - 0.001) == middle


def test_what_is_too_wide_or_upside_down_has_no_grasp(shapes):
    wide = to_standing(shapes.estimate(1, "can", shapes.can(radius=0.045, height=0.14)))
    assert not lying_grasps(wide, lying_pose(0.045)).grasps
    assert lying_grasps(wide, np.diag([1.0, -1, -1, 1])).rejected["upside down"] == 1


def test_where_only_a_short_neck_fits_the_hand_it_comes_obliquely_too(shapes):
    """Last, turned about the axis, with the fingertips above the support."""
    profile = np.array([(0, 0), (0.045, 0), (0.045, 0.16), (0.014, 0.18), (0.014, 0.215), (0, 0.215)])
    item = to_standing(shapes.estimate(1, "bottle", trimesh.creation.revolve(profile, sections=48)))
    T_world_stand = lying_pose(0.045)
    grasps = lying_grasps(item, T_world_stand).grasps
    approaches = np.array([(T_world_stand @ grasp.T_stand_tcp)[:3, 2] for grasp in grasps])
    angles = np.degrees(np.arccos(np.clip(-approaches[:, 2], -1, 1)))
    assert sorted(set(angles.round())) == [0, 25, 45]
    straight = angles < 1
    n_straight = straight[: len(grasps) // 2].sum()
    assert straight[:n_straight].all() and not straight[n_straight : len(grasps) // 2].any()
    np.testing.assert_allclose(approaches @ T_world_stand[:3, 2], 0.0, atol=1e-9)
    for grasp in grasps:
        assert grasp.T_stand_tcp[2, 2] == pytest.approx(0.0, abs=1e-9), "set upright, the hand is horizontal"
        tip = T_world_stand @ np.append(grasp.T_stand_tcp[:3, 3] - 0.01 * grasp.away, 1.0)
        assert tip[2] > 0.0
    long = np.array([(0, 0), (0.03, 0), (0.03, 0.2), (0, 0.2)])
    item = to_standing(shapes.estimate(1, "can", trimesh.creation.revolve(long)))
    T_world_stand = lying_pose(0.03)
    for grasp in lying_grasps(item, T_world_stand).grasps:
        assert (T_world_stand @ grasp.T_stand_tcp)[2, 2] == pytest.approx(-1.0), "there are enough places"
