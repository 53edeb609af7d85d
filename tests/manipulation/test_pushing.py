"""Pushes of the closed hand along the table."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from manipulation.collision import AllowedContacts
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE, Obstacle
from manipulation.pick_place import PickPlacePlanner
from manipulation.pushing import DISTANCES, plan_push
from manipulation.standing import to_standing
from perception.geometry import pose_from_yaw
from tests.manipulation.test_execution import CONFIG

RADIUS, HEIGHT = 0.03, 0.10
AT = np.array([0.5, -0.2])
AXIS = np.array([1.0, 0.0, 0.0])  # of the can on its side


@pytest.fixture(scope="module")
def can(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(RADIUS, HEIGHT), x=AT[0], y=AT[1]))


def block(name, x, y, half_x, half_y, half_z=0.03):
    return Obstacle(name, (float(x), float(y), half_z), (half_x, half_y, half_z))


def beside(gap=0.002):
    """Two blocks along the can's sides, with no room for a finger."""
    y = RADIUS + gap + 0.02
    return [block(f"block_{s}", AT[0], AT[1] + s * y, HEIGHT / 2, 0.02) for s in (-1, 1)]


@pytest.fixture
def make_planner(can, arm):
    def make(lying=True, blocks=()):
        planner = PickPlacePlanner(Kinematics(arm), {can.name: can}, (TABLE, *blocks), CONFIG.pick_place)
        T = pose_from_yaw(0.0, np.array([*AT, 0.0]))
        if lying:  # base at the near end of the axis
            T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
            T[:3, 3] = AT[0] - HEIGHT / 2, AT[1], RADIUS
        planner.scene.moved(can.name, T)
        return planner, T

    return make


def push_of(planner, can, arm, helps):
    return plan_push(planner.motions, can, np.array(arm.q_home), helps)


def test_what_no_finger_fits_beside_is_pushed_out_along_its_axis(make_planner, can, arm) -> None:
    planner, T = make_planner(blocks=beside())
    assert not planner.can_pick(can.name, T)
    push = push_of(planner, can, arm, lambda T_after: planner.can_pick(can.name, T_after))
    assert push is not None
    step = push.T_world_stand[:3, 3] - T[:3, 3]
    assert abs(step[1]) < 0.4 * abs(step[0]) and step[2] == 0.0, "about along the axis"
    assert np.linalg.norm(step) in [pytest.approx(d) for d in DISTANCES]
    np.testing.assert_array_equal(push.T_world_stand[:3, :3], T[:3, :3])
    assert planner.can_pick(can.name, push.T_world_stand)


def test_the_motions_follow_one_another_and_meet_the_object_alone(make_planner, can, arm) -> None:
    planner, T = make_planner(blocks=beside())
    push = push_of(planner, can, arm, lambda T_after: T_after[0, 3] > T[0, 3] + 0.04)
    motions = (push.transit, push.approach, push.push, push.retreat)
    for before, after in itertools.pairwise(motions):
        np.testing.assert_allclose(before.positions[-1], after.positions[0], atol=1e-6)
    world, kinematics, touch = (
        planner.scene.world,
        planner.kinematics,
        AllowedContacts(touch=frozenset({can.name})),
    )
    for motion in (push.transit, push.approach):
        assert world.path_contact(motion.positions, 0.0) is None
    assert world.path_contact(push.push.positions, 0.0, touch) is None
    start, end = (kinematics.forward(q)[:3, 3] for q in (push.push.positions[0], push.push.positions[-1]))
    way = end - start
    assert way[2] == pytest.approx(0.0, abs=2e-3) and way[1] / way[0] == pytest.approx(0.0, abs=0.45)
    moved = np.linalg.norm(push.T_world_stand[:3, 3] - T[:3, 3])
    assert np.linalg.norm(way) == pytest.approx(moved + 0.01, abs=2e-3), "from 1 cm behind it"
    assert start[0] < AT[0] - HEIGHT / 2 - 0.01


def test_what_can_be_grasped_is_not_pushed(make_planner, can, arm) -> None:
    planner, _ = make_planner()
    assert push_of(planner, can, arm, lambda T_after: True) is None


@pytest.mark.parametrize("least", [0.02, 0.06])
def test_the_shortest_distance_that_helps_is_taken(make_planner, can, arm, least) -> None:
    planner, T = make_planner(lying=False)
    push = push_of(planner, can, arm, lambda T_after: np.linalg.norm((T_after - T)[:2, 3]) > least)
    moved = np.linalg.norm((push.T_world_stand - T)[:2, 3])
    assert moved == pytest.approx(min(d for d in DISTANCES if d > least))


def test_nothing_is_pushed_into_other_things(make_planner, can, arm) -> None:
    """Walls at both ends of the axis: the only free directions are oblique ones, into the blocks beside."""
    ends = [block(f"end_{s}", AT[0] + s * (HEIGHT / 2 + 0.04), AT[1], 0.01, 0.06) for s in (-1, 1)]
    planner, T = make_planner(blocks=[*beside(), *ends])
    asked = []

    def helps(T_after):
        asked.append(T_after)
        return not np.array_equal(T_after, T)

    assert push_of(planner, can, arm, helps) is None
    assert len(asked) == 1, "where nothing can be pushed to, no grasp is looked for"


@pytest.mark.parametrize(("blocked", "sign"), [(None, 1), (-1, None)])
def test_it_is_pushed_from_its_base_if_the_hand_fits_behind_that(
    make_planner, can, arm, blocked, sign
) -> None:
    """From the other end it would be pushed into what is behind its base."""
    behind = [block("behind", AT[0] - HEIGHT / 2 - 0.02, AT[1], 0.01, 0.03, half_z=0.06)] if blocked else []
    planner, T = make_planner(blocks=[*beside(), *behind])
    push = push_of(planner, can, arm, lambda T_after: not np.array_equal(T_after, T))
    assert (push is None) == (sign is None)
    if push is not None:
        assert push.T_world_stand[0, 3] > T[0, 3]


@pytest.mark.parametrize("is_round", [True, False])
def test_only_what_cannot_roll_is_pushed_across_its_axis(make_planner, can, arm, is_round) -> None:
    planner, T = make_planner()
    item = replace(can, is_round=is_round)
    push = push_of(planner, item, arm, lambda T_after: abs(T_after[1, 3] - T[1, 3]) > 0.028)
    assert push is not None
    step = (push.T_world_stand - T)[:2, 3]
    assert np.linalg.norm(step) == pytest.approx(DISTANCES[-1] if is_round else DISTANCES[0])
    assert (abs(step[0]) < 1e-6) is not is_round


def test_the_object_is_where_it_was_in_the_planners_world(make_planner, can, arm) -> None:
    planner, T = make_planner(blocks=beside())
    push_of(planner, can, arm, lambda T_after: planner.can_pick(can.name, T_after))
    np.testing.assert_array_equal(planner.scene.pose(can.name), T)
    assert planner.scene.world.contact(np.array(arm.q_home), 0.0) is None
