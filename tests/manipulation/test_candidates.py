"""Similar grasps, counts of discarded candidates, and the order of yaws."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from manipulation.candidates import NO_WAY, Tally, are_similar, ordered_yaws
from manipulation.grasps import grasp_candidates
from manipulation.motions import OUT_OF_REACH
from manipulation.standing import to_standing
from manipulation.types import GraspSet, Placement, Rejected


@pytest.fixture
def item(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.25))


@pytest.fixture
def grasp(item):
    return grasp_candidates(item).grasps[0]


def at(T, x, y):
    moved = T.copy()
    moved[:2, 3] = x, y
    return moved


@pytest.mark.parametrize(
    "turn, deeper, kind, similar",
    [
        (np.deg2rad(19), 0.002, "top", True),
        (np.deg2rad(21), 0.0, "top", False),
        (2 * np.pi - 0.1, 0.0, "top", True),
        (0.0, 0.004, "top", False),
        (0.0, 0.0, "rim", False),
    ],
)
def test_grasps_near_each_other_are_similar(grasp, turn, deeper, kind, similar):
    other = replace(grasp, azimuth=grasp.azimuth + turn, depth=grasp.depth + deeper, kind=kind)
    assert are_similar(grasp, other) == similar


def test_the_message_counts_reasons_and_names_a_remedy(grasp):
    tally, candidates = Tally(), GraspSet((grasp,), Counter())
    for rejected in (
        Rejected("collide with mug_2", "mug_2"),
        Rejected("collide with mug_2", "mug_2"),
        OUT_OF_REACH,
    ):
        tally.reject(rejected)
    assert tally.in_the_way == ("mug_2",)
    assert tally.failure_message("can_1", candidates) == (
        "No plan for can_1: of 3 candidates, 2 collide with mug_2, 1 out of reach; "
        "clear its surroundings or move the box"
    )
    for _ in range(2):
        tally.reject(OUT_OF_REACH)
    assert tally.failure_message("can_1", candidates).endswith("; move it closer to the arm")


def test_without_grasps_the_message_is_theirs():
    none = GraspSet((), Counter({"too low": 3}))
    assert Tally().failure_message("can_1", none) == none.failure_message("can_1")


def test_yaws_that_follow_the_rotation_of_the_base_come_first(item, grasp):
    swing = 2 * np.arctan2(0.25, 0.5)
    yaws = tuple(swing + np.array([2.0, -0.1, 0.4, -1.0]))
    placement = Placement("can_1", (0.5, 0.25, 0.0), yaws)
    now, goal = at(item.T_world_stand, 0.5, -0.25), at(np.eye(4), 0.5, 0.25)
    assert ordered_yaws(now, goal, grasp.T_stand_tcp, placement) == [yaws[1], yaws[2], yaws[3], yaws[0]]


def test_yaws_of_a_hand_far_from_vertical_point_it_away_from_the_base(item):
    level = np.eye(4)[[2, 1, 0, 3]]  # z along x
    placement = Placement("can_1", (0.5, 0.5, 0.0), (0.0, np.pi, 0.7, -2.0))
    yaws = ordered_yaws(item.T_world_stand, at(np.eye(4), 0.5, 0.5), level, placement)
    assert yaws == [0.7, 0.0, np.pi, -2.0]  # outwards is pi / 4


def test_a_posture_that_no_path_leads_from_is_enclosed():
    tally = Tally()
    tally.reject(OUT_OF_REACH)
    assert not tally.is_enclosed
    tally.reject(NO_WAY)
    assert tally.is_enclosed and "without a collision-free path to the object" in tally.reasons
