import numpy as np
import pytest

from manipulation.collision import AllowedContacts, CollisionWorld, Contact
from manipulation.kinematics import Kinematics
from manipulation.motions import MotionPlanner
from manipulation.obstacles import TABLE, Obstacle
from manipulation.trajectories import MotionConfig
from manipulation.types import Rejected

WIDTH = 0.04
# Between postures at negative and at positive y: to be crossed above 0.25 m, out of reach above 1.2 m.
WALL = Obstacle("wall", (0.5, 0.0, 0.125), (0.2, 0.02, 0.125))
TALL_WALL = Obstacle("wall", (0.0, 0.0, 0.6), (2.0, 0.02, 0.6))


@pytest.fixture(scope="module")
def kinematics(arm):
    return Kinematics(arm)


def motions_among(kinematics, *obstacles):
    world = CollisionWorld(kinematics.arm, [], (TABLE, *obstacles))
    return MotionPlanner(kinematics, world, MotionConfig(line_step=0.02), (0.35, 0.45))


def down(x, y, z):
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = x, y, z
    return T


def posture(kinematics, x, y, z):
    T = down(x, y, z)
    result = kinematics.inverse(T, kinematics.seeds_toward(T))
    assert result.converged
    return result.q


@pytest.fixture(scope="module")
def ends(kinematics):
    """Postures on both sides of the wall, lower than its top."""
    return posture(kinematics, 0.5, -0.2, 0.15), posture(kinematics, 0.5, 0.2, 0.15)


def test_a_free_direct_move_is_taken(kinematics, ends):
    motions = motions_among(kinematics)
    path = motions.free_path(*ends, WIDTH)
    assert len(path) == 2
    assert path[0] == pytest.approx(ends[0]) and path[1] == pytest.approx(ends[1])


def test_a_blocked_move_is_led_over_the_obstacle(kinematics, ends):
    motions = motions_among(kinematics, WALL)
    assert motions.world.path_contact(np.stack(ends), WIDTH) == Contact("arm", "wall")
    path = motions.free_path(*ends, WIDTH)
    assert path is not None and len(path) > 2
    assert path[0] == pytest.approx(ends[0]) and path[-1] == pytest.approx(ends[1])
    assert motions.world.path_contact(np.stack(path), WIDTH) is None


def test_no_path_through_an_obstacle_that_cannot_be_avoided(kinematics, ends):
    assert motions_among(kinematics, TALL_WALL).free_path(*ends, WIDTH) is None


def test_where_no_simple_path_is_free_one_is_searched_for(kinematics, ends, monkeypatch):
    motions = motions_among(kinematics, WALL)
    simple = motions.any_path(*ends, WIDTH, (0.06, 0.004))
    np.testing.assert_array_equal(simple, motions.free_path(*ends, WIDTH, (0.06, 0.004)))
    monkeypatch.setattr(motions, "free_path", lambda *_: None)
    path = motions.any_path(*ends, WIDTH, (0.06, 0.004))
    assert path[0] == pytest.approx(ends[0]) and path[-1] == pytest.approx(ends[1])
    kept = AllowedContacts(robot_margin=0.004)
    assert motions.world.path_contact(np.stack(path), WIDTH, kept) is None
    assert all(kinematics.within_limits(q) for q in path)
    under = posture(kinematics, 0.5, 0.0, 0.05)
    assert motions.world.contact(under, WIDTH) is not None
    assert motions.any_path(under, ends[1], WIDTH) is None, "it begins in the wall"


def test_the_first_margin_that_some_path_keeps_is_used(kinematics, ends):
    motions = motions_among(kinematics, WALL)
    assert motions.free_path(*ends, WIDTH, (0.5,)) is None
    wide = motions.free_path(*ends, WIDTH, (0.5, 0.06, 0.0))
    assert motions.world.path_contact(np.stack(wide), WIDTH, AllowedContacts(robot_margin=0.06)) is None


def test_way_points_are_never_below_the_ends(kinematics):
    """From postures above all way point heights the way points stay at the height of the ends."""
    motions = motions_among(kinematics)
    ends = posture(kinematics, 0.45, -0.2, 0.5), posture(kinematics, 0.45, 0.2, 0.5)
    vias = [q for via in motions._waypoints(*ends) for q in via]
    assert vias
    assert all(kinematics.forward(q)[2, 3] == pytest.approx(0.5, abs=1e-3) for q in vias)


def test_the_first_free_line_is_taken(kinematics):
    q = posture(kinematics, 0.5, -0.2, 0.15)
    motions = motions_among(kinematics, WALL)
    blocked, free = down(0.5, 0.2, 0.15), down(0.5, -0.2, 0.3)
    line = motions.free_line(q, [blocked, free], WIDTH)
    assert kinematics.forward(line[-1])[:3, 3] == pytest.approx([0.5, -0.2, 0.3], abs=2e-4)
    assert motions.free_line(q, [blocked], WIDTH) == Rejected("collide with wall (hand)")
    assert motions.free_line(q, [down(1.5, -0.2, 0.15)], WIDTH) == Rejected("out of reach")
    allowed = motions.free_line(q, [blocked], WIDTH, AllowedContacts(frozenset({"wall"})))
    assert kinematics.forward(allowed[-1])[:3, 3] == pytest.approx([0.5, 0.2, 0.15], abs=2e-4)


def test_behind_what_a_line_meets_nothing_is_looked_for(kinematics, monkeypatch):
    """Neither the rest of that line nor a longer one; a shorter one, or one elsewhere, may be free."""
    q, solved = posture(kinematics, 0.5, -0.2, 0.15), []
    motions = motions_among(kinematics, WALL)
    inverse = kinematics.inverse
    monkeypatch.setattr(
        kinematics, "inverse", lambda T, *a, **k: solved.append(T[1, 3]) or inverse(T, *a, **k)
    )
    whole, longer, shorter = (down(0.5, y, 0.15) for y in (0.2, 0.25, -0.16))
    line = motions.free_line(q, [whole, longer, shorter], WIDTH)
    assert kinematics.forward(line[-1])[:3, 3] == pytest.approx([0.5, -0.16, 0.15], abs=2e-4)
    assert max(solved) < 0.0 and len(solved) < 10
    solved.clear()
    motions.free_line(q, [whole, down(0.5, 0.2, 0.16)], WIDTH)
    assert sum(y == pytest.approx(-0.18, abs=2e-3) for y in solved) == 2, "another line is followed as far"


def test_a_line_from_a_posture_in_contact_is_rejected_without_inverse_kinematics(kinematics, monkeypatch):
    q = posture(kinematics, 0.5, -0.2, -0.01)
    monkeypatch.setattr(kinematics, "inverse", None)
    rejected = motions_among(kinematics).free_line(q, [down(0.5, -0.2, 0.2)], WIDTH)
    assert isinstance(rejected, Rejected) and rejected.blocker == TABLE.name and not rejected.by_arm


@pytest.mark.parametrize(
    ("contact", "by_arm"),
    [
        (Contact("arm", "can_1", "link5"), True),
        (Contact("arm", "can_1", "hand"), False),
        (Contact("arm", "link3", "hand"), True),  # the hand against the arm itself
        (Contact("can_1", "can_2"), False),  # carried
    ],
)
def test_other_postures_may_avoid_what_links_meet(kinematics, contact, by_arm):
    assert motions_among(kinematics).rejection(contact).by_arm is by_arm


@pytest.mark.parametrize("load", ["none", "carried", "pushed"])
def test_lines_are_timed_from_rest_to_rest_by_what_they_do(kinematics, ends, load):
    motions = motions_among(kinematics)
    line = motions.free_line(ends[0], [down(0.5, -0.2, 0.25)], WIDTH)
    timed = motions.time_line(line, load)
    assert timed.positions[0] == pytest.approx(line[0]) and timed.positions[-1] == pytest.approx(line[-1])
    c = motions.config
    v, a = {
        "none": (c.line_speed, c.line_acceleration),
        "carried": (c.carrying_speed, c.carrying_acceleration),
        "pushed": (c.pushing_speed, c.pushing_acceleration),
    }[load]
    least = 0.1 / v + v / a if v**2 / a < 0.1 else 2 * np.sqrt(0.1 / a)
    assert least + c.line_averaging <= timed.duration < 1.1 * (least + c.line_averaging)


def test_paths_are_timed_from_rest_to_rest(kinematics, ends):
    motions = motions_among(kinematics)
    middle = 0.5 * (ends[0] + ends[1])
    path = motions.time_path([ends[0], middle, ends[1]])
    assert path.positions[-1] == pytest.approx(ends[1])
    assert np.abs(path.positions - middle).max(axis=1).min() < 1e-9


def test_swing_is_the_tilt_on_the_way(kinematics, ends):
    motions = motions_among(kinematics)
    start = ends[0]
    tilted = start + 0.8 * np.eye(len(start))[5]  # the wrist's pitch
    assert motions.swing([start, tilted, start]) == pytest.approx(0.8, abs=1e-6)
    assert motions.swing([start, tilted]) == pytest.approx(0.0, abs=1e-6)  # turned on purpose
    turned = start + 0.8 * np.eye(len(start))[6]  # about the vertical
    assert motions.swing([start, turned, start]) == pytest.approx(0.0, abs=1e-2)


def test_a_level_path_does_not_swing(kinematics, ends, monkeypatch):
    motions = motions_among(kinematics)
    start, goal = ends
    swinging, level = [start, start + 0.9 * np.eye(len(start))[5], start], [start, goal]
    monkeypatch.setattr(motions, "candidate_paths", lambda *_: iter([swinging, level]))
    assert motions.free_path(start, goal, WIDTH) == swinging
    assert motions.carrying_path(start, goal, WIDTH) == (level, True)
    monkeypatch.setattr(motions, "candidate_paths", lambda *_: iter([swinging]))
    assert motions.carrying_path(start, goal, WIDTH) == (swinging, False)


def test_a_search_that_finds_nothing_checks_each_detour_once(kinematics, ends, monkeypatch):
    motions = motions_among(kinematics, TALL_WALL)
    n_detours = len(list(motions.candidate_paths(*ends))) - 1
    checked = []
    whole = motions.world.path_contact
    monkeypatch.setattr(motions.world, "path_contact", lambda *args: checked.append(args) or whole(*args))
    assert motions.carrying_path(*ends, WIDTH, (0.03, 0.012, 0.004)) is None
    assert n_detours > 0 and len(checked) == 3 + n_detours


def test_level_comes_before_a_larger_clearance(kinematics, ends, monkeypatch):
    """The level path touches the wall at 6 cm, the swinging one is free there."""
    motions = motions_among(kinematics)
    start, goal = ends
    swinging, level = [start, start + 0.9 * np.eye(len(start))[5], start], [start, goal]
    monkeypatch.setattr(motions, "candidate_paths", lambda *_: iter([swinging, level]))

    def contact(postures, width, allowed):
        is_tight = len(postures) == 2 and allowed.robot_margin == 0.06
        return Contact("arm", "wall") if is_tight else None

    monkeypatch.setattr(motions.world, "path_contact", contact)
    assert motions.carrying_path(start, goal, WIDTH, (0.06, 0.0)) == (level, True)
    assert motions.free_path(start, goal, WIDTH, (0.06, 0.0)) == swinging
