"""Which grasps are generated anew after an object was moved or its surroundings have changed."""

import numpy as np
import pytest

from manipulation.grasp_config import GraspConfig
from manipulation.known_grasps import KnownGrasps
from manipulation.standing import to_standing

CONFIG = GraspConfig(n_azimuths=4, top_depths=(0.02,))


@pytest.fixture
def around():
    """Points around the can; the names that were asked for."""
    return {"points": np.zeros((0, 3)), "asked": []}


@pytest.fixture
def can(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.25))


@pytest.fixture
def known(can, around):
    def points(name):
        around["asked"].append(name)
        return around["points"]

    return KnownGrasps({can.name: can}, CONFIG, points)


@pytest.fixture
def lying(can):
    T = can.T_world_stand.copy()
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    return T


def test_grasps_of_what_stands_depend_on_its_shape_alone(known, can, around):
    grasps = known.at(can.name, can.T_world_stand)
    known.on_move(can.name)
    known.on_change()
    assert known.at(can.name, can.T_world_stand) is grasps and around["asked"] == []


def test_grasps_of_what_lies_depend_on_its_pose(known, can, lying):
    grasps = known.at(can.name, lying)
    known.on_change()
    assert known.at(can.name, lying) is grasps
    known.on_move(can.name)
    assert known.at(can.name, lying) is not grasps


@pytest.mark.parametrize("method", ["tilted", "keeping"])
@pytest.mark.parametrize("pose", ["standing", "lying"])
def test_hands_at_any_angle_avoid_the_surroundings_as_they_are(known, can, lying, around, method, pose):
    T = lying if pose == "lying" else can.T_world_stand
    free = getattr(known, method)(can.name, T)
    assert getattr(known, method)(can.name, T) is free and around["asked"] == [can.name]
    # A wall of points where the hand comes from, in the stand frame.
    corners = np.linspace(-0.2, 0.2, 41)
    x, y = (c.ravel() for c in np.meshgrid(corners, corners))
    level = np.stack([x, y, np.full(x.size, can.top + 0.03)], axis=1)
    around["points"] = level if pose == "standing" else level[:, [2, 1, 0]] * [-1, 1, 1]
    known.on_change()
    blocked = getattr(known, method)(can.name, T)
    antipodal = [sum(g.kind == "antipodal" for g in grasps.grasps) for grasps in (free, blocked)]
    assert antipodal[0] > antipodal[1]


def test_a_bowl_in_another_can_be_held_by_the_top_of_its_rim(shapes):
    """The fingertips stay above the rim of the bowl that it stands in, here 14 mm below its own."""
    bowl = to_standing(shapes.estimate(2, "bowl", shapes.bowl(0.05, 0.055), x=0.5, y=-0.25))
    known = KnownGrasps({bowl.name: bowl}, CONFIG, lambda name: np.zeros((0, 3)))
    tip = CONFIG.gripper.tip

    def lowest(grasps):
        rim = [g.T_stand_tcp for g in grasps.grasps if g.kind == "rim"]
        assert rim
        return max((T[:3, 3] + tip * T[:3, 2])[2] for T in rim)

    assert lowest(known.keeping(bowl.name, bowl.T_world_stand)) > bowl.top - 0.014
    assert lowest(known.at(bowl.name, bowl.T_world_stand)) < bowl.top - 0.014


def test_between_close_walls_the_fingers_stay_near_to_the_one_that_they_grasp(shapes):
    bowl = to_standing(shapes.estimate(2, "bowl", shapes.bowl(0.05, 0.055), x=0.5, y=-0.25))
    known = KnownGrasps({bowl.name: bowl}, CONFIG, lambda name: np.zeros((0, 3)))
    openings = [grasp.opening for grasp in known.keeping(bowl.name, bowl.T_world_stand).grasps]
    assert openings[0] == pytest.approx(2 * CONFIG.half_opening)
    assert openings[-1] == pytest.approx(2 * CONFIG.narrow().half_opening)


def test_what_stands_is_not_turned(known, can):
    assert known.tilted(can.name, can.T_world_stand) is known.keeping(can.name, can.T_world_stand)


def test_given_grasps_are_used(can, known, around):
    given = known.at(can.name, can.T_world_stand)
    other = KnownGrasps({can.name: can}, CONFIG, around.get, {can.name: given})
    assert other.at(can.name, can.T_world_stand) is given
