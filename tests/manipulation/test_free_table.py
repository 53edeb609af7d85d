import numpy as np
import pytest

from manipulation.free_table import (
    FREE_AREA,
    free_spots,
    goals_aside,
    outline_of,
    outline_of_thing,
    outlines_of_others,
    roomy_spots,
)
from manipulation.standing import to_standing
from perception.geometry import pose_from_yaw
from perception.obstacles.obstacle import PerceivedObstacle

SQUARE = 0.1 * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@pytest.fixture(scope="module")
def can(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(0.03, 0.1)))


def on_side(x=0.5, y=-0.2):
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    T[:3, 3] = x, y, 0.03
    return T


def test_outlines_are_those_of_the_present_pose(can):
    standing = outline_of(can, pose_from_yaw(0.7, np.array([0.5, -0.2, 0.0])))
    np.testing.assert_allclose(np.ptp(standing, axis=0), 0.06, atol=2e-3)
    lying = outline_of(can, on_side())
    np.testing.assert_allclose(np.ptp(lying, axis=0), (0.1, 0.06), atol=2e-3)
    np.testing.assert_allclose(lying.min(axis=0), (0.5, -0.23), atol=1e-3)
    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=float)
    thing = outline_of_thing(PerceivedObstacle(0, (corners, corners + 1.0), 100))
    np.testing.assert_allclose((thing.min(axis=0), thing.max(axis=0)), ((0, 0), (2, 2)))


def test_spots_keep_clear_of_outlines_and_within_the_area():
    corner = np.array([0.45, -0.3])
    spots = np.array(list(free_spots(0.03, [corner + SQUARE])))
    outside = np.maximum(np.maximum(corner - spots, spots - corner - 0.1), 0.0)
    assert len(spots) > 3 and outside.max(axis=1).min() > 0.049
    (x0, x1), (y0, y1) = FREE_AREA
    assert ((spots > (x0 - 1e-9, y0 - 1e-9)) & (spots < (x1 + 1e-9, y1 + 1e-9))).all()
    assert not list(free_spots(0.03, [np.array([0.2, -0.6]) + 8 * SQUARE]))


def is_far(spots: np.ndarray) -> np.ndarray:
    return np.linalg.norm(spots, axis=1) > 1.2 * np.linalg.norm(np.mean(FREE_AREA, axis=1))


def test_spots_begin_in_the_middle_and_are_apart():
    spots = np.array(list(free_spots(0.03, [])))
    distance = np.linalg.norm(spots[~is_far(spots)] - np.mean(FREE_AREA, axis=1), axis=1)
    assert distance[0] < 0.03 and (np.diff(distance) > -1e-9).all()
    between = np.linalg.norm(spots[:, None] - spots, axis=-1) + np.eye(len(spots))
    assert between.min() >= 0.07


def test_spots_with_room_for_the_hand_come_first():
    wall = np.array([[0.28, -0.6], [0.28, 0.1], [0.50, 0.1], [0.50, -0.6]])
    spots = np.array(list(free_spots(0.03, [wall])))
    x = spots[~is_far(spots), 0]
    roomy = x > 0.50 + 0.13 - 1e-9
    assert roomy.any() and not roomy.all() and roomy[: roomy.sum()].all()


def test_spots_far_from_the_base_come_after_nearer_ones_with_as_much_room():
    far = is_far(np.array(list(free_spots(0.03, []))))
    assert far.any() and not far[: (~far).sum()].any()
    crowded = [np.array([0.3, -0.3]) + 3 * SQUARE]  # most near spots have less room
    far = is_far(np.array(list(free_spots(0.03, crowded))))
    assert far[: (~far).sum()].any() and not far.all()


@pytest.mark.parametrize(("height", "seen_within"), [(0.20, 0.245), (0.26, 0.205)])
def test_spots_where_few_images_show_the_top_of_a_tall_object_come_last(height, seen_within):
    spots = np.array(list(free_spots(0.03, [], height=height)))
    is_cut = np.linalg.norm(spots - np.mean(FREE_AREA, axis=1), axis=1) > seen_within + 0.02
    is_sure = np.linalg.norm(spots - np.mean(FREE_AREA, axis=1), axis=1) < seen_within - 0.02
    near = ~is_far(spots)
    assert np.flatnonzero(near & is_sure).max() < np.flatnonzero(near & is_cut).min()
    assert is_cut.any() and not (is_cut & near)[: is_sure.sum() // 2].any()


def test_what_is_set_aside_keeps_its_orientation_and_lies_on_the_table(can):
    T = on_side()
    goals = list(goals_aside(can, T, []))
    assert goals
    for goal in goals:
        T_rest = pose_from_yaw(0.0, np.array(goal.position)) @ goal.T_goal_stand
        np.testing.assert_allclose(T_rest[:3, :3], T[:3, :3])
        points = can.vertices @ T_rest[:3, :3].T + T_rest[:3, 3]
        assert points[:, 2].min() == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(points[:, 1].mean(), goal.position[1], atol=2e-3)


def test_what_stands_or_leans_is_set_aside_upright(can):
    leaning = np.eye(4)
    leaning[1:3, 1:3] = [[0.9, -(0.19**0.5)], [0.19**0.5, 0.9]]
    for T in (pose_from_yaw(0.7, np.array([0.5, -0.2, 0.0])), leaning):
        goal = next(goals_aside(can, T, []))
        np.testing.assert_allclose(goal.T_goal_stand[:3, 2], (0, 0, 1), atol=1e-9)
        assert (can.vertices @ goal.T_goal_stand[:3, :3].T + goal.T_goal_stand[:3, 3])[:, 2].min() == 0.0


def test_outlines_of_others_are_those_of_all_but_some_and_of_things(can):
    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=float)
    things = [PerceivedObstacle(0, (corners,), 100)]
    poses = {"a": np.eye(4), "b": pose_from_yaw(0.0, np.array([0.5, 0.0, 0.0]))}
    one, thing = outlines_of_others({"a": can, "b": can}, poses, things, {"a"})
    assert one[:, 0].min() == pytest.approx(0.47, abs=1e-3) and thing.max() == 1.0


def test_roomy_spots_have_more_room_than_a_crowded_place(can):
    x, y = 0.45, -0.3
    neighbour = SQUARE + np.array([x + 0.02, y - 0.05])
    spots = np.array(roomy_spots((x, y), 0.1, [neighbour]))
    beyond = np.maximum(neighbour.min(axis=0) - spots, spots - neighbour.max(axis=0)).clip(0.0)
    assert len(spots) and (np.linalg.norm(beyond, axis=1) > 0.13 - 1e-9).all()
    apart = np.linalg.norm(spots - (x, y), axis=1)
    assert (np.diff(apart) >= 0).all() and apart[0] < 0.15
    assert not roomy_spots((x, y), 0.1, [neighbour + np.array([0.2, 0.0])]), "there is room where it is"


def test_with_little_free_table_spots_are_as_roomy_as_possible():
    (x0, x1), _ = area = ((0.3, 0.6), (-0.3, 0.0))
    walls = [6 * SQUARE + np.array([x, -0.5]) for x in (x0 - 0.6, x1)]  # 0.3 m apart
    spots = np.array(roomy_spots((x0 + 0.01, -0.1), 0.18, walls, area))
    assert len(spots) and (np.abs(spots[:, 0] - 0.45) < 0.3 / 2 - 0.7 * 0.18 + 1e-6).all()
