from dataclasses import replace

import numpy as np
import pytest

from manipulation.collision import AllowedContacts, Body, CollisionWorld
from manipulation.grasps import grasp_candidates
from manipulation.hulls import convex_pieces
from manipulation.kinematics import Kinematics
from manipulation.motions import OUT_OF_REACH, MotionPlanner
from manipulation.obstacles import TABLE
from manipulation.pick_place_segments import Pick, Place, PlaceGoal, SegmentConfig, find_pick, find_place
from manipulation.standing import to_standing
from manipulation.trajectories import MotionConfig
from manipulation.types import Placement, Rejected
from perception.geometry import pose_from_yaw
from perception.obstacles.obstacle import PerceivedObstacle

CONFIG = SegmentConfig()


class RecordingPlanner(MotionPlanner):
    """Records each line that is requested; ``reject`` maps the index of a request to a result."""

    def __init__(self, kinematics, world):
        super().__init__(kinematics, world, MotionConfig(line_step=0.03), (0.4,))
        self.lines, self.reject = [], {}

    def free_line(self, q, targets, width, allowed=None, end_margin=None):
        self.lines.append((targets, width, allowed, next(iter(self.world._carried), None)))
        if len(self.lines) in self.reject:
            return self.reject[len(self.lines)]
        return super().free_line(q, targets, width, allowed, end_margin)


@pytest.fixture(scope="module")
def kinematics(arm):
    return Kinematics(arm)


@pytest.fixture(scope="module")
def can(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.2))


@pytest.fixture(scope="module")
def bowl(shapes):
    return to_standing(shapes.estimate(1, "bowl", shapes.bowl(), x=0.5, y=-0.2))


def motions_among(kinematics, *items):
    bodies = [Body(item.name, convex_pieces(item), item.T_world_stand) for item in items]
    return RecordingPlanner(kinematics, CollisionWorld(kinematics.arm, bodies, (TABLE,)))


def reachable_pick(motions, item):
    for grasp in grasp_candidates(item).grasps:
        pick = find_pick(motions, item.name, grasp, CONFIG)
        if isinstance(pick, Pick):
            motions.lines.clear()
            return pick
    raise AssertionError("no grasp is reachable")


def heights_above(T, targets):
    return [target[2, 3] - T[2, 3] for target in targets]


def test_pick_approaches_from_above_and_lifts_with_the_object_attached(kinematics, can):
    motions = motions_among(kinematics, can)
    grasp = reachable_pick(motions, can).grasp
    pick = find_pick(motions, can.name, grasp, CONFIG)
    T_grasp = can.T_world_stand @ grasp.T_stand_tcp
    (approach, lift) = motions.lines
    assert heights_above(T_grasp, approach[0]) == pytest.approx(CONFIG.approach_heights)
    assert approach[1:] == (grasp.opening, AllowedContacts(touch=frozenset({"can_1"})), None)
    assert heights_above(T_grasp, lift[0]) == pytest.approx(CONFIG.lift.heights)
    table = AllowedContacts(touch_carried=frozenset({"table"}), carried_margin=CONFIG.lift.margin)
    assert lift[1:] == (grasp.held_width, table, "can_1")
    np.testing.assert_allclose(kinematics.forward(pick.approach[-1]), T_grasp, atol=2e-3)
    assert kinematics.forward(pick.approach[0])[2, 3] == pytest.approx(T_grasp[2, 3] + 0.16, abs=1e-3)
    assert kinematics.forward(pick.lift[-1])[2, 3] == pytest.approx(T_grasp[2, 3] + 0.2, abs=1e-3)


@pytest.mark.parametrize("index", [1, 2])
def test_rejected_segments_of_a_pick_are_passed_on(kinematics, can, index):
    motions = motions_among(kinematics, can)
    grasp = reachable_pick(motions, can).grasp
    motions.reject = {index: Rejected("collide with shelf")}
    assert find_pick(motions, can.name, grasp, CONFIG) == Rejected("collide with shelf")


def test_a_neighbour_between_the_fingers_rejects_the_grasp(kinematics, can, shapes):
    """Bottles 42 mm from the can's side on four sides are within the opened fingers."""
    motions = motions_among(kinematics, can)
    grasp = reachable_pick(motions, can).grasp
    x, y = can.T_world_stand[:2, 3] + 0.06 * (can.T_world_stand @ grasp.T_stand_tcp)[:2, 1]
    bottle = to_standing(shapes.estimate(2, "bottle", shapes.bottle(0.02, 0.25), x=float(x), y=float(y)))
    crowded = motions_among(kinematics, can, bottle)
    assert find_pick(crowded, can.name, grasp, CONFIG) == Rejected("collide with bottle_2 (link7)")


def test_the_elbow_gives_way_to_what_a_link_would_meet(kinematics, can):
    """A post behind the can, where the forearm is in the first posture found for its grasp."""
    corners = [[0.38 + i, -0.13 + j, z] for i in (-0.01, 0.01) for j in (-0.01, 0.01) for z in (0.25, 0.6)]
    post = PerceivedObstacle(0, (np.array(corners),), 1)
    bodies = [Body(can.name, convex_pieces(can), can.T_world_stand)]
    motions = MotionPlanner(
        kinematics,
        CollisionWorld(kinematics.arm, bodies, (TABLE, post)),
        MotionConfig(line_step=0.03),
        (0.4,),
    )
    grasp = grasp_candidates(can).grasps[0]
    T = can.T_world_stand @ grasp.T_stand_open
    first = kinematics.inverse(T, kinematics.seeds_toward(T, 3)).q
    contact = motions.world.contact(first, grasp.opening, AllowedContacts(touch=frozenset({can.name})))
    assert contact.obstacle == post.name and motions.rejection(contact).by_arm

    pick = find_pick(motions, can.name, grasp, CONFIG)
    assert isinstance(pick, Pick)
    assert kinematics.forward(pick.approach[-1]) == pytest.approx(T, abs=2e-3)
    placed = Placement(can.name, (0.5, -0.2, 0.0), (0.0,))
    place = find_place(motions, pick, PlaceGoal(can, placed, can.T_world_stand), CONFIG)
    assert isinstance(place, Place)


def test_picks_beyond_the_reach(kinematics, can):
    motions = motions_among(kinematics, can)
    grasp = grasp_candidates(can).grasps[0]
    motions.world.move("can_1", pose_from_yaw(0.0, np.array([1.4, 0.0, 0.0])))
    assert find_pick(motions, can.name, grasp, CONFIG) is OUT_OF_REACH


def goal_of(item, **changes):
    placement = replace(Placement(item.name, (0.5, 0.2, 0.0), (0.0,), release_height=0.01), **changes)
    return PlaceGoal(item, placement, pose_from_yaw(0.0, np.array(placement.position)))


def test_place_lowers_the_object_to_the_release_height_and_retreats(kinematics, can):
    motions = motions_among(kinematics, can)
    pick = reachable_pick(motions, can)
    place = find_place(motions, pick, goal_of(can), CONFIG)
    assert isinstance(place, Place) and place.settle is None
    np.testing.assert_allclose(place.T_world_stand_goal[:3, 3], (0.5, 0.2, 0.01))
    T_place = place.T_world_stand_goal @ pick.grasp.T_stand_tcp
    release, lowering = motions.lines
    width = min(pick.grasp.release_opening + 2 * CONFIG.release_extras[0], pick.grasp.opening)
    assert release[1:] == (width, AllowedContacts(touch=frozenset({"can_1"})), None)
    assert place.release_opening == width
    assert heights_above(T_place, release[0]) == pytest.approx(CONFIG.retreat_heights)
    floor = AllowedContacts(
        touch_carried=frozenset({"table", "box_floor"}), carried_margin=CONFIG.placing_margin
    )
    assert lowering[1:] == (pick.grasp.held_width, floor, "can_1")
    assert heights_above(T_place, lowering[0]) == pytest.approx(CONFIG.raise_heights[:1])
    np.testing.assert_allclose(kinematics.forward(place.lowering[-1]), T_place, atol=2e-3)
    assert kinematics.forward(place.retreat[-1])[2, 3] == pytest.approx(T_place[2, 3] + 0.1, abs=1e-3)


@pytest.mark.parametrize(
    ("top", "gap", "heights", "height"),
    [
        (0.115, 0.008, CONFIG.raise_heights, 0.18),  # from 12 cm, it would pass 15 mm above the neighbour
        (0.165, 0.008, CONFIG.raise_heights, 0.25),
        (0.165, 0.040, CONFIG.raise_heights, 0.12),
        (0.165, 0.008, (0.05, 0.08), 0.05),  # neither clears it
    ],
)
def test_an_object_is_lowered_from_above_its_neighbours(kinematics, shapes, top, gap, heights, height):
    can = to_standing(shapes.estimate(1, "can", shapes.can(0.03, 0.18), x=0.5, y=-0.2))
    neighbour = to_standing(shapes.estimate(2, "can", shapes.can(0.03, top), x=0.7, y=-0.2))
    motions = motions_among(kinematics, can, neighbour)
    pick = reachable_pick(motions, can)
    beside_fingers = pick.grasp.T_stand_tcp[:3, 0]  # horizontal, across their motion
    at = np.array([0.5, 0.2, 0.0]) + (0.06 + gap) * beside_fingers
    motions.world.move("can_2", pose_from_yaw(0.0, at))
    place = find_place(motions, pick, goal_of(can), replace(CONFIG, raise_heights=heights))
    assert isinstance(place, Place), place
    T_place = place.T_world_stand_goal @ pick.grasp.T_stand_tcp
    begin = kinematics.forward(place.lowering[0])
    assert begin[2, 3] - T_place[2, 3] == pytest.approx(height, abs=1e-3)


def test_release_openings_are_tried_from_wide_to_narrow(kinematics, can):
    motions = motions_among(kinematics, can)
    pick = reachable_pick(motions, can)
    narrow = replace(pick.grasp, release_opening=0.07, opening=0.08)
    pick = replace(pick, grasp=narrow)
    motions.reject = {1: Rejected("collide with shelf"), 2: OUT_OF_REACH}
    place = find_place(motions, pick, goal_of(can), CONFIG)
    assert [line[1] for line in motions.lines[:3]] == pytest.approx([0.08, 0.078, 0.07])
    assert place.release_opening == pytest.approx(0.07)


def test_reasons_of_a_rejected_place(kinematics, can):
    motions = motions_among(kinematics, can)
    pick = reachable_pick(motions, can)
    far = goal_of(can, position=(1.4, 0.2, 0.0))
    assert find_place(motions, pick, far, CONFIG) == Rejected("with the goal out of reach")
    motions.reject = {1: OUT_OF_REACH, 2: OUT_OF_REACH, 3: Rejected("collide with mug_2")}
    reason = "without a collision-free release (collide with mug_2)"
    assert find_place(motions, pick, goal_of(can), CONFIG) == Rejected(reason)
    motions.lines.clear()
    motions.reject = dict.fromkeys(range(2, 7), Rejected("collide with mug_2"))
    assert find_place(motions, pick, goal_of(can), CONFIG) == Rejected("collide with mug_2 while lowering")


def test_bowls_on_the_floor_settle_before_the_release(kinematics, bowl, shapes):
    lower = to_standing(shapes.estimate(2, "bowl", shapes.bowl(0.09, slope=0.4), x=0.3, y=0.4))
    motions = motions_among(kinematics, bowl, lower)
    pick = reachable_pick(motions, bowl)
    place = find_place(motions, pick, goal_of(bowl), CONFIG)
    T_place = place.T_world_stand_goal @ pick.grasp.T_stand_tcp
    sunk = kinematics.forward(place.settle[-1])
    assert sunk[2, 3] == pytest.approx(T_place[2, 3] - CONFIG.settle_depth, abs=5e-4)
    assert motions.lines[0][1] == pick.grasp.release_opening
    np.testing.assert_allclose(place.retreat[0], place.settle[-1])
    motions.lines.clear()
    nested = find_place(motions, pick, goal_of(bowl, stack=("bowl_2",)), CONFIG)
    assert isinstance(nested, Place) and nested.settle is None
    stack = frozenset({"bowl_2"})
    assert motions.lines[0][2].touch == stack | {"bowl_1"}
    assert motions.lines[-1][2].touch == stack
    assert motions.lines[-1][2].touch_carried == stack | {"table", "box_floor"}
