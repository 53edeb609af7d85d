import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE, box_obstacles
from manipulation.pick_place import PickPlacePlanner
from manipulation.pressing import (
    can_lean,
    highest_rim_point,
    is_plausible,
    is_pressable,
    lean,
    lowest_leaning,
    plan_press,
    resting_height,
)
from manipulation.standing import to_standing
from manipulation.types import Box
from perception.geometry import levelled, pose_from_yaw
from tests.manipulation.test_execution import CONFIG

RADIUS, HEIGHT, TILT = 0.06, 0.045, 0.3


def leaning(x, y, z=0.02, towards=0.7, tilt=TILT):
    """A pose whose axis leans in the direction ``towards``."""
    T = pose_from_yaw(0.4, np.array([x, y, z]))
    axis = np.array([-np.sin(towards), np.cos(towards), 0.0])
    T[:3, :3] = Rotation.from_rotvec(tilt * axis).as_matrix() @ T[:3, :3]
    return T


@pytest.fixture(scope="module")
def bowl(shapes):
    return to_standing(shapes.estimate(1, "bowl", shapes.bowl(RADIUS, HEIGHT)))


def test_lean():
    assert lean(leaning(0.5, 0.2)) == pytest.approx(TILT) and lean(pose_from_yaw(1.0, np.zeros(3))) == 0.0


def test_what_bowls_in_one_another_cannot_look_like():
    steep, slight = leaning(0.5, 0.2, tilt=0.7), leaning(0.5, 0.2, tilt=0.5)
    assert is_plausible({"upper": slight, "lower": slight}) and is_plausible({})
    assert not is_plausible({"upper": slight, "lower": steep})


@pytest.mark.parametrize(
    ("rise", "tilt", "possible"),
    [
        (0.0, 0.1, True),
        (0.009, 0.1, True),
        (0.012, 0.1, False),
        (0.012, 0.2, True),
        (0.012, 0.0, False),
        (0.04, 0.3, True),
    ],
)
def test_a_leaning_bowl_rises_no_more_than_its_radius_allows(bowl, rise, tilt, possible):
    """At 0.1 rad the middle of a base of 0.06 m rises by 6 mm."""
    seen = leaning(0.5, 0.2, z=0.02 + rise, tilt=tilt)
    assert can_lean(bowl, pose_from_yaw(0.4, np.array([0.5, 0.2, 0.02])), seen) == possible


@pytest.mark.parametrize(
    ("tilts", "pressed"),
    [
        ((0.02, 0.02), None),
        ((0.1, 0.02), "upper"),
        ((0.1, 0.1), "upper"),
        ((0.1, 0.2), "middle"),
        ((0, 0.2), "middle"),
    ],
)
def test_the_lowest_bowl_that_leans_is_pressed_first(tilts, pressed):
    """From 5 degrees on the uppermost, from 8 on those that it hides in part; the lowest stands."""
    seen = {name: leaning(0.5, 0.2, tilt=a) for name, a in zip(("upper", "middle"), tilts, strict=True)}
    names = ("upper", "middle", "lowest")
    assert lowest_leaning(names, seen | {"lowest": leaning(0.5, 0.2, tilt=0.3)}) == pressed
    assert lowest_leaning(names, {"lowest": seen["middle"]}) is None


@pytest.mark.parametrize("towards", [0.0, 0.7, -2.5])
def test_the_highest_point_is_opposite_to_where_the_bowl_leans(bowl, towards):
    """A disc of radius r at height h, tilted by a: its highest point is at h cos a + r sin a."""
    point = highest_rim_point(bowl, leaning(0.5, 0.2, 0.02, towards))
    direction = np.array([np.cos(towards), np.sin(towards)])
    along = (point[:2] - (0.5, 0.2)) @ direction
    r = RADIUS - 0.004  # of the rim, less the margin to its edge
    assert point[2] == pytest.approx(0.02 + HEIGHT * np.cos(TILT) + r * np.sin(TILT), abs=0.002)
    assert along == pytest.approx(HEIGHT * np.sin(TILT) - r * np.cos(TILT), abs=0.003)
    assert np.cross(direction, point[:2] - (0.5, 0.2)) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("tilt", "radius", "x", "pressable"),
    [
        (0.5, 0.06, 0.5, True),
        (0.5, 0.06, 0.535, False),
        (0.5, 0.08, 0.535, True),
        (0.4, 0.06, 0.535, True),
    ],
)
def test_a_bowl_that_leans_much_is_pressed_over_a_cavity_alone(bowl, shapes, tilt, radius, x, pressable):
    """At 0.5 rad its highest point is 28 mm beside the middle of its base, on the side that is in the way."""
    beneath = to_standing(shapes.estimate(2, "bowl", shapes.bowl(radius, 0.06)))
    seen = leaning(0.5, 0.2, towards=0.0, tilt=tilt)
    assert is_pressable(bowl, seen, beneath, pose_from_yaw(0.0, np.array([x, 0.2, 0.0]))) == pressable


def test_the_closed_hand_goes_down_to_the_height_at_rest(bowl, arm):
    planner = PickPlacePlanner(
        Kinematics(arm), {"bowl_1": bowl}, (TABLE, *box_obstacles(Box())), CONFIG.pick_place
    )
    T = leaning(*Box().center)
    planner.scene.moved("bowl_1", levelled(T, 0.012))
    rest = pose_from_yaw(0.0, np.array([*Box().center, 0.012]))
    press = plan_press(planner.motions, bowl, T, rest, arm.q_home, frozenset({"bowl_1"}))
    assert press is not None and press.draw is None
    kinematics = planner.motions.kinematics
    over, at = (kinematics.forward(press.down.positions[i]) for i in (0, -1))
    tip = arm.gripper.tip
    target = highest_rim_point(bowl, T)
    assert at[:3, 3] == pytest.approx((*target[:2], 0.012 + bowl.top + tip - 0.002), abs=1e-3)
    assert over[:3, 3] == pytest.approx((*target[:2], target[2] + tip + 0.04), abs=1e-3)
    assert at[:3, 2] == pytest.approx((0, 0, -1), abs=2e-3)
    assert press.transit.positions[-1] == pytest.approx(press.down.positions[0], abs=1e-6)
    assert press.up.positions[-1] == pytest.approx(press.down.positions[0], abs=1e-6)


@pytest.mark.parametrize("aside", [0.0, 0.012])
def test_a_point_that_is_pressed_is_drawn_to_the_middle(bowl, arm, aside):
    """By how far the bowl is aside, and 4 mm, away from where it is highest; then straight up."""
    planner = PickPlacePlanner(
        Kinematics(arm), {"bowl_1": bowl}, (TABLE, *box_obstacles(Box())), CONFIG.pick_place
    )
    T, towards = leaning(*Box().center), 0.7
    uphill = -np.array([np.cos(towards), np.sin(towards)])
    planner.scene.moved("bowl_1", levelled(T, 0.012))
    rest = pose_from_yaw(0.0, np.array([*(np.array(Box().center) - aside * uphill), 0.012]))
    press = plan_press(planner.motions, bowl, T, rest, arm.q_home, frozenset({"bowl_1"}), draws=True)
    assert press is not None and press.draw is not None
    forward = planner.motions.kinematics.forward
    at, drawn, above = (forward(m.positions[-1])[:3, 3] for m in (press.down, press.draw, press.up))
    assert drawn - at == pytest.approx((*(-(aside + 0.004) * uphill), 0.0), abs=1e-3)
    assert above[:2] == pytest.approx(drawn[:2], abs=1e-3)
    assert above[2] == pytest.approx(forward(press.down.positions[0])[2, 3], abs=1e-3)


def test_there_is_no_press_where_the_hand_cannot_go(bowl, arm):
    planner = PickPlacePlanner(Kinematics(arm), {"bowl_1": bowl}, (TABLE,), CONFIG.pick_place)
    touched = frozenset({"bowl_1"})
    rest = pose_from_yaw(0.0, np.array([0.5, 0.2, 0.0]))
    assert plan_press(planner.motions, bowl, leaning(1.3, 0.2), rest, arm.q_home, touched) is None
    planner.scene.moved("bowl_1", levelled(leaning(0.5, 0.2), 0.0))
    assert plan_press(planner.motions, bowl, leaning(0.5, 0.2), rest, arm.q_home, frozenset()) is None, (
        "nothing may be touched"
    )


@pytest.mark.parametrize(
    ("seen", "tilt", "height"),
    [(0.053, 0.0, 0.060), (0.051, 0.0, 0.051), (0.058, 0.2, 0.058), (0.065, 0.0, 0.060), (0.065, 0.2, 0.060)],
)
def test_a_bowl_is_at_its_planned_height_unless_it_is_seen_lower(seen, tilt, height):
    planned, found = pose_from_yaw(0.0, np.array([0, 0, 0.06])), pose_from_yaw(0.0, np.array([0, 0, seen]))
    found[:3, :3] = Rotation.from_euler("x", tilt).as_matrix()
    assert resting_height(planned, found) == pytest.approx(height)
