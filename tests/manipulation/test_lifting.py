"""Lifts: straight up, or away from what the object touches or would sag into."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation.collision import AllowedContacts, Body, CollisionWorld
from manipulation.grasps import grasp_candidates
from manipulation.hulls import convex_pieces
from manipulation.kinematics import Kinematics
from manipulation.lifting import FAR
from manipulation.lying_grasps import lying_grasps
from manipulation.motions import MotionPlanner
from manipulation.obstacles import TABLE
from manipulation.pick_place_segments import Pick, SegmentConfig, find_pick
from manipulation.standing import to_standing
from manipulation.trajectories import MotionConfig
from manipulation.types import Rejected
from perception.geometry import pose_from_yaw
from perception.obstacles.obstacle import PerceivedObstacle

CONFIG = SegmentConfig()
STRAIGHT = replace(CONFIG, lift=replace(CONFIG.lift, oblique_azimuths=()))
RADIUS, HEIGHT = 0.026, 0.18  # [m] of a can on its side


@pytest.fixture(scope="module")
def kinematics(arm):
    return Kinematics(arm)


@pytest.fixture(scope="module")
def can(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.2))


@pytest.fixture(scope="module")
def bowl(shapes):
    return to_standing(shapes.estimate(1, "bowl", shapes.bowl(), x=0.5, y=-0.2))


@pytest.fixture(scope="module")
def lying(shapes):
    item = to_standing(shapes.estimate(1, "can", shapes.can(RADIUS, HEIGHT)))
    on_side = np.eye(4)
    on_side[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    return replace(item, T_world_stand=pose_from_yaw(np.pi / 2, np.array([0.45, -0.25, RADIUS])) @ on_side)


def among(kinematics, item, *others, things=()):
    bodies = [Body(i.name, convex_pieces(i), i.T_world_stand) for i in (item, *others)]
    world = CollisionWorld(kinematics.arm, bodies, (TABLE, *things))
    return MotionPlanner(kinematics, world, MotionConfig(line_step=0.03), (0.4,))


def first_grasp(motions, item):
    grasps = grasp_candidates(item).grasps
    return next(g for g in grasps if isinstance(find_pick(motions, item.name, g, CONFIG), Pick))


def block(low, high):
    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=float)
    return PerceivedObstacle(0, (np.array(low) + corners * np.subtract(high, low),), 1000)


def block_beside(item, toward, gap, height):
    """A block that leaves a gap to an upright item along an axis of the world."""
    middle = item.T_world_stand[:2, 3] + toward * (np.ptp(item.vertices[:, 0]) / 2 + 0.01 + gap)
    return block([*(middle - 0.01), 0.0], [*(middle + 0.01), height])


def across(item, grasp):
    """The axis of the world nearest to the direction across that in which the hand closes."""
    beside = (item.T_world_stand @ grasp.T_stand_tcp)[:2, 0]
    toward = np.zeros(2)
    axis = np.argmax(np.abs(beside))
    toward[axis] = np.sign(beside[axis])
    return toward


def step_of(kinematics, lift):
    return kinematics.forward(lift[-1])[:3, 3] - kinematics.forward(lift[0])[:3, 3]


def is_straight(kinematics, pick):
    return bool(np.linalg.norm(step_of(kinematics, pick.lift)[:2]) < 1e-3)


def test_what_touches_nothing_is_lifted_straight(kinematics, can, bowl):
    for item in (can, bowl):
        motions = among(kinematics, item)
        pick = find_pick(motions, item.name, first_grasp(motions, item), CONFIG)
        assert isinstance(pick, Pick) and is_straight(kinematics, pick)


def test_what_touches_another_object_is_lifted_away_from_it_or_along_it(kinematics, can, shapes):
    grasp = first_grasp(among(kinematics, can), can)
    beside = (can.T_world_stand @ grasp.T_stand_tcp)[:2, 0]  # across the closing direction
    x, y = can.T_world_stand[:2, 3] + 0.0525 * beside  # the sum of the radii less half a millimetre
    low = to_standing(shapes.estimate(2, "can", shapes.can(0.02, 0.05), x=float(x), y=float(y)))
    motions = among(kinematics, can, low)
    pick = find_pick(motions, can.name, grasp, CONFIG)
    assert isinstance(pick, Pick) and step_of(kinematics, pick.lift)[:2] @ beside < -0.04
    pick = find_pick(motions, can.name, grasp, STRAIGHT)
    assert isinstance(pick, Pick) and is_straight(kinematics, pick)


@pytest.mark.parametrize(("overlap", "is_lifted"), [(0.003, True), (0.015, True), (0.03, False)])
def test_what_touches_a_thing_of_no_class_is_lifted_along_it(kinematics, can, overlap, is_lifted):
    grasp = first_grasp(among(kinematics, can), can)
    thing = block_beside(can, across(can, grasp), -overlap, 0.04)
    pick = find_pick(among(kinematics, can, things=(thing,)), can.name, grasp, STRAIGHT)
    assert isinstance(pick, Pick) if is_lifted else pick == Rejected("collide with thing_0")


@pytest.mark.parametrize("height", [0.04, 0.12])
def test_what_leans_against_a_thing_is_carried_on_from_clear_of_it(kinematics, can, height):
    """A vertical lift by 8 cm along a thing of 12 cm ends in contact with it."""
    grasp = first_grasp(among(kinematics, can), can)
    toward = across(can, grasp)
    motions = among(kinematics, can, things=(block_beside(can, toward, -0.001, height),))
    short, straight = (
        replace(config, lift=replace(config.lift, heights=(0.08,))) for config in (CONFIG, STRAIGHT)
    )
    pick = find_pick(motions, can.name, grasp, short)
    assert isinstance(pick, Pick)
    assert step_of(kinematics, pick.lift)[:2] @ toward < -0.04
    margin = CONFIG.lift.end_margin
    clear = AllowedContacts(robot_margin=margin, carried_margin=margin)
    assert motions.world.contact(pick.lift[-1], grasp.held_width, clear) is None
    assert isinstance(find_pick(motions, can.name, grasp, straight), Pick) is (height < 0.08)


def test_what_is_below_a_ledge_is_lifted_obliquely_away_from_it(kinematics, bowl):
    grasp = first_grasp(among(kinematics, bowl), bowl)
    center = bowl.T_world_stand[:2, 3]
    rim = (bowl.T_world_stand @ grasp.T_stand_tcp)[:2, 3] - center
    along = rim / np.linalg.norm(rim)
    sideways = np.array([-along[1], along[0]])
    edge = np.ptp(bowl.vertices[:, 0]) / 2 - 0.02  # over 2 cm of the bowl, opposite to the hand
    corners = [
        [*(center - distance * along + side * sideways), height]
        for distance in (edge, edge + 0.06)
        for side in (-0.1, 0.1)
        for height in (bowl.top + 0.04, bowl.top + 0.06)
    ]
    motions = among(kinematics, bowl, things=(PerceivedObstacle(0, (np.array(corners),), 1000),))
    pick = find_pick(motions, bowl.name, grasp, CONFIG)
    assert isinstance(pick, Pick)
    step = step_of(kinematics, pick.lift)
    assert step[:2] @ along > 0.05 and step[2] > 0.05


def test_what_stands_in_another_object_is_lifted_straight_out_of_its_hull(kinematics, shapes):
    estimates = [
        shapes.estimate(1, "can", shapes.can(0.03, 0.1), x=0.5, y=-0.2, lift=0.02),
        shapes.estimate(2, "bowl", shapes.bowl(0.08, 0.05), x=0.5, y=-0.2),
    ]
    inside, around = to_standing(replace(estimates[0], rests_on=2)), to_standing(estimates[1])
    assert inside.T_world_stand[2, 3] == pytest.approx(0.02)
    motions = among(kinematics, inside, around)
    pick = find_pick(motions, inside.name, first_grasp(motions, inside), CONFIG)
    assert isinstance(pick, Pick) and is_straight(kinematics, pick)


@pytest.mark.parametrize(
    ("is_far", "gap", "height", "is_oblique"),
    [
        (True, 0.004, 0.10, True),  # its upper edge moves by 2 mm when it sags
        (True, 0.012, 0.10, False),
        (True, 0.004, 0.02, False),  # the lower half of its end recedes
        (False, 0.004, 0.10, False),
    ],
    ids=["sags", "away", "low", "middle"],
)
def test_what_would_sag_into_a_thing_is_lifted_away_from_it(
    kinematics, lying, is_far, gap, height, is_oblique
):
    """Held near one end of the can, or at its middle; the thing is beyond the other end."""
    grasps = lying_grasps(lying, lying.T_world_stand, least_height=0.0).grasps
    rank = sorted(grasps, key=lambda grasp: grasp.T_stand_tcp[2, 3] - HEIGHT / 2)
    grasp = rank[-1] if is_far else min(rank, key=lambda grasp: abs(grasp.T_stand_tcp[2, 3] - HEIGHT / 2))
    assert bool(abs(grasp.T_stand_tcp[2, 3] - HEIGHT / 2) > FAR) is is_far
    x, y = lying.T_world_stand[:2, 3]  # of the base, which is at the end of the can towards negative y
    thing = block([x - 0.03, y - gap - 0.02, 0.0], [x + 0.03, y - gap, height])
    motions = among(kinematics, lying, things=(thing,))
    pick = find_pick(motions, lying.name, grasp, CONFIG)
    assert isinstance(pick, Pick)
    assert bool(step_of(kinematics, pick.lift)[1] > 0.04) is is_oblique
    assert is_oblique or is_straight(kinematics, pick)
    assert motions.world.contact(pick.lift[-1], grasp.held_width) is None, "the object hangs as it is held"
