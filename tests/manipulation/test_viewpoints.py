import itertools
from dataclasses import replace

import numpy as np
import pytest

from manipulation.collision import CollisionWorld
from manipulation.errors import PlanningError
from manipulation.kinematics import IkResult, Kinematics
from manipulation.nearest_view import DISTANCES, MAX_OFF_AXIS, view_angle
from manipulation.obstacles import TABLE
from manipulation.robot import RobotState
from manipulation.viewpoints import (
    BOX_VIEWPOINTS,
    FEW,
    KEEP_OUT,
    LINE_VIEWPOINTS,
    MAX_TURN,
    ROLLS,
    SCAN_VIEWPOINTS,
    Viewpoint,
    ViewpointScanner,
    closeup_viewpoints,
    scan_viewpoints,
    viewpoint_ik,
    viewpoints_around,
    with_near_views,
)
from perception.types import CameraIntrinsics, RgbdFrame
from sim_assets.robots import load_robot
from sim_assets.robots.panda_arm import arm_description


@pytest.fixture(scope="module")
def kinematics():
    return Kinematics(arm_description())


@pytest.mark.parametrize("roll", ROLLS)
def test_the_optical_axis_passes_through_the_target_at_the_distance(roll):
    view = Viewpoint((0.4, -0.2, 0.05), azimuth=0.7, elevation=1.0, distance=0.55)
    T = view.camera_pose(roll)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    target_camera = np.linalg.inv(T) @ (*view.target, 1.0)
    np.testing.assert_allclose(target_camera[:3], (0, 0, 0.55), atol=1e-12)


def test_without_roll_the_image_is_level_and_upright():
    T = Viewpoint((0.4, -0.2, 0.05), azimuth=0.7, elevation=0.8, distance=0.5).camera_pose()
    assert T[2, 0] == pytest.approx(0.0)  # image x is horizontal
    assert T[2, 1] < 0  # image y points down


@pytest.mark.parametrize(
    "views", [SCAN_VIEWPOINTS, BOX_VIEWPOINTS, LINE_VIEWPOINTS, closeup_viewpoints((0.45, -0.3, 0.05))]
)
def test_the_scripted_viewpoints_are_within_reach(kinematics, views):
    q = np.array(kinematics.arm.q_home)
    for view in views:
        found = viewpoint_ik(kinematics, view, q)
        assert found is not None
        T = kinematics.forward(found, "camera")
        np.testing.assert_allclose(T[:3, 3], view.camera_pose()[:3, 3], atol=2e-4)
        np.testing.assert_allclose(T[:3, 2], view.camera_pose()[:3, 2], atol=2e-3)
        q = found


class Moving:
    """A robot that records its trajectories."""

    arm = arm_description()

    def __init__(self, q):
        self.q, self.tracks = np.array(q), []

    def state(self):
        return RobotState(0.0, self.joint_positions(), self.gripper_width())

    def stop(self, reason):
        raise AssertionError(reason)

    def joint_positions(self):
        return self.q

    def gripper_width(self):
        return 0.08

    def follow(self, trajectory):
        np.testing.assert_allclose(trajectory.positions[0], self.q, atol=1e-6)
        self.q = np.array(trajectory.positions[-1])
        self.tracks.append(trajectory.positions)

    def move_gripper(self, width):
        return width

    def capture(self):
        camera = CameraIntrinsics(4, 3, 4.0, 4.0, 1.5, 1.0)
        return RgbdFrame(0.0, np.zeros((3, 4, 3), np.uint8), np.ones((3, 4)), camera)


@pytest.mark.parametrize("views", [SCAN_VIEWPOINTS, BOX_VIEWPOINTS, LINE_VIEWPOINTS])
def test_no_motion_enters_the_keep_out_volumes(kinematics, views):
    robot = Moving(kinematics.arm.q_home)
    assert len(ViewpointScanner(robot, kinematics).capture(views)) == len(views)
    world = CollisionWorld(robot.arm, [], (TABLE, *KEEP_OUT))
    assert all(world.path_contact(track[::10], 0.08) is None for track in robot.tracks)


def test_a_first_motion_may_start_inside_a_keep_out_volume(kinematics):
    low = kinematics.forward(np.array(kinematics.arm.q_home))
    low[:3, 3] = (0.45, -0.25, 0.2)
    robot = Moving(kinematics.inverse(low, kinematics.seeds_toward(low, 3)).q)
    assert len(ViewpointScanner(robot, kinematics).capture(SCAN_VIEWPOINTS)) == len(SCAN_VIEWPOINTS)
    # Straight up until it is outside: what stands beside the hand is not touched.
    world = CollisionWorld(robot.arm, [], (TABLE, *KEEP_OUT))
    inside = [q for track in robot.tracks for q in track[::10] if world.contact(q, 0.08) is not None]
    places = np.array([kinematics.forward(q)[:3, 3] for q in inside])
    assert len(places) > 2 and np.ptp(places[:, 2]) > 0.05
    assert np.abs(places[:, :2] - (0.45, -0.25)).max() < 0.003


def test_looking_without_colour_is_left_to_the_robot(kinematics):
    robot = Moving(kinematics.arm.q_home)
    scanner = ViewpointScanner(robot, kinematics)
    assert scanner.look(color=False).depth.shape == (3, 4)  # a robot without depth images captures
    black = replace(robot.capture(), time=7.0)
    robot.capture_depth = lambda: black
    assert scanner.look(color=False).time == 7.0 and scanner.look().time == 0.0


class Still:
    """A robot that must not be moved."""

    arm = arm_description()

    def state(self):
        return RobotState(0.0, self.joint_positions(), self.gripper_width())

    def stop(self, reason):
        raise AssertionError(reason)

    def joint_positions(self):
        return np.array(self.arm.q_home)

    def gripper_width(self):
        return 0.0

    def follow(self, trajectory):
        raise AssertionError("it must not move")

    def move_gripper(self, width):
        return width

    def capture(self):
        raise AssertionError("there is nothing to see")


def test_targets_out_of_reach_are_an_error(kinematics):
    with pytest.raises(PlanningError, match="none of 2 viewpoints can be reached"):
        ViewpointScanner(Still(), kinematics).capture(closeup_viewpoints((2.0, 0.0, 0.0)))


def test_roll_rotates_the_image_about_the_optical_axis():
    view = Viewpoint((0.4, -0.2, 0.05), azimuth=0.7, elevation=0.8, distance=0.5)
    relative = np.linalg.inv(view.camera_pose()) @ view.camera_pose(roll=0.3)
    expected = np.eye(4)
    expected[:2, :2] = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    np.testing.assert_allclose(relative, expected, atol=1e-12)


def test_viewpoints_are_given_in_degrees():
    (view,) = viewpoints_around((0.4, -0.2, 0.05), [(90, 60, 0.5)])
    assert view == Viewpoint((0.4, -0.2, 0.05), np.pi / 2, np.deg2rad(60), 0.5)
    np.testing.assert_allclose(view.camera_pose()[:3, 3], (0.4, -0.2 + 0.25, 0.05 + 0.5 * np.sin(np.pi / 3)))


def test_closeup_viewpoints_are_on_the_side_towards_the_middle():
    for y, sign in ((0.3, -1), (-0.3, 1)):
        for view in closeup_viewpoints((0.45, y, 0.05)):
            assert np.sign(view.camera_pose()[1, 3] - y) == sign


class Solutions:
    """Inverse kinematics with one solution per roll, and a limit distance that the solution determines."""

    def __init__(self, arm, solutions):
        self.arm, self.solutions = arm, list(solutions)

    def __call__(self, T_world_target, seeds, frame, name):
        q, converged = self.solutions.pop(0)
        status = "converged" if converged else "not_converged"
        return IkResult(np.full(7, q), status, 0.0, 0.0, 1)


def test_the_nearest_solution_within_the_limit_distance_is_used(kinematics, monkeypatch):
    """Of eight rolls two are nearer, but not converged or too near to a joint limit."""
    solutions = [(0.1, False), (0.2, True), (0.9, True), (0.5, True), (-0.7, True), *[(1.0, True)] * 3]
    monkeypatch.setattr(kinematics, "inverse", Solutions(kinematics.arm, solutions))
    monkeypatch.setattr(kinematics, "limit_distance", lambda q: 0.09 if q[0] == 0.2 else 0.11)
    found = viewpoint_ik(kinematics, SCAN_VIEWPOINTS[0], np.zeros(7))
    np.testing.assert_array_equal(found, np.full(7, 0.5))


@pytest.mark.parametrize("name", ["panda", "sixaxis"])
def test_the_arm_at_home_is_outside_the_keep_out_volumes(name):
    """From inside one, motions are not checked; the six-axis arm has its shoulder beside the first axis."""
    arm = load_robot(name).description
    assert CollisionWorld(arm, [], (TABLE, *KEEP_OUT)).contact(np.array(arm.q_home), 0.08) is None


def test_a_viewpoint_is_visited_with_the_elbow_on_the_other_side_if_the_arm_is_in_the_way(monkeypatch):
    """Of the six-axis arm, whose nearest postures at a viewpoint may have the elbow among the objects."""
    arm = load_robot("sixaxis").description
    kinematics, view = Kinematics(arm), SCAN_VIEWPOINTS[5]
    q_low = np.array([-1.32, 0.81, -0.06, 1.24, -1.3, -3.39])
    robot = Moving(q_low)
    robot.arm = arm
    scanner = ViewpointScanner(robot, kinematics)
    world = scanner.motions.world
    assert world.contact(q_low, 0.08) is None
    assert world.contact(viewpoint_ik(kinematics, view, q_low), 0.08) is not None, "the elbow is low there"
    assert len(scanner.capture([view])) == 1
    T = kinematics.forward(robot.q, "camera")
    np.testing.assert_allclose(T[:3, 3], view.camera_pose()[:3, 3], atol=2e-4)
    assert all(world.path_contact(track[::10], 0.08) is None for track in robot.tracks)


def test_a_viewpoint_out_of_reach_is_replaced_by_a_view_from_nearly_the_same_direction():
    """Farther away than the arm reaches; there is none from a side from which the wrist cannot look back."""
    kinematics = Kinematics(replace(arm_description(), near_views=True))
    q, view = kinematics.arm.q_home, replace(SCAN_VIEWPOINTS[1], distance=1.0)
    found, camera, target = (
        viewpoint_ik(kinematics, view, q),
        view.camera_pose()[:3, 3],
        np.array(view.target),
    )
    assert found is not None and kinematics.limit_distance(found) > 0.09
    T = kinematics.forward(found, "camera")
    away = np.linalg.norm(target - T[:3, 3])
    assert DISTANCES[0] < away < 0.98 and view_angle(kinematics, found, target, camera) < MAX_TURN
    assert (target - T[:3, 3]) @ T[:3, 2] > away * np.cos(MAX_OFF_AXIS)
    back = Viewpoint(view.target, azimuth=0.0, elevation=0.3, distance=0.5)
    assert viewpoint_ik(kinematics, back, q) is None
    assert viewpoint_ik(Kinematics(arm_description()), view, q) is None


@pytest.mark.parametrize(("reached", "near"), [(FEW - 1, True), (FEW, False)])
def test_an_arm_that_reaches_few_viewpoints_takes_near_views(reached, near):
    views = SCAN_VIEWPOINTS[:reached] + tuple(
        replace(view, distance=2.0) for view in SCAN_VIEWPOINTS[reached:]
    )
    assert with_near_views(arm_description(), views).near_views == near


def test_viewpoints_out_of_reach_are_skipped_and_frames_reported(kinematics):
    robot, frames, steps = Moving(kinematics.arm.q_home), [], []
    far = closeup_viewpoints((2.0, 0.0, 0.0))[0]
    scanner = ViewpointScanner(robot, kinematics)
    captured = scanner.capture(
        [SCAN_VIEWPOINTS[0], far, SCAN_VIEWPOINTS[1]], lambda *step: steps.append(step), frames.append
    )
    assert len(captured) == 2 and all(a is b for a, b in zip(captured, frames, strict=True))
    assert steps == [(1, 3), (3, 3)]


def test_a_viewpoint_is_visited_again_in_the_posture_of_before(kinematics, monkeypatch):
    """From elsewhere another roll of the camera would be nearer; it is taken if the way there is blocked."""
    robot, (view, *_, away) = Moving(kinematics.arm.q_home), BOX_VIEWPOINTS
    scanner = ViewpointScanner(robot, kinematics)
    scanner.capture([view], as_before=True)
    q_first = robot.q
    q_away = viewpoint_ik(kinematics, away, q_first)
    q_away[6] += np.pi / 2 * (1 if q_away[6] < 0 else -1)
    robot.q = q_away
    scanner.capture([view], as_before=True)
    np.testing.assert_allclose(robot.q, q_first, atol=1e-9)
    free_path = scanner.motions.free_path
    q_nearest = viewpoint_ik(kinematics, view, q_away)
    assert np.abs(q_nearest - q_first).max() > 0.3

    def blocked(q, to, *args):
        return None if np.allclose(to, q_first) else free_path(q, to, *args)

    for is_blocked in (False, True):  # images that are not compared leave no trace
        robot.q = q_away
        scanner.capture([view], as_before=is_blocked)
        np.testing.assert_allclose(robot.q, q_nearest, atol=1e-9)
        monkeypatch.setattr(scanner.motions, "free_path", blocked)
    robot.q = q_first
    scanner.capture([view], as_before=True)  # the last posture counts
    np.testing.assert_allclose(robot.q, q_nearest, atol=1e-9)


def test_a_viewpoint_that_is_blocked_in_its_turn_is_visited_last(kinematics, monkeypatch, caplog):
    scanner, steps, asked = ViewpointScanner(Moving(kinematics.arm.q_home), kinematics), [], []
    path_to = scanner._path_to

    def blocked_at_first(viewpoint, *args):
        asked.append(viewpoint)
        return None if len(asked) == 2 else path_to(viewpoint, *args)

    monkeypatch.setattr(scanner, "_path_to", blocked_at_first)
    first, blocked, last = SCAN_VIEWPOINTS[:3]
    captured = scanner.capture([first, blocked, last], lambda *step: steps.append(step))
    assert asked == [first, blocked, last, blocked] and len(captured) == 3 and not caplog.records
    assert steps == [(1, 3), (3, 3), (3, 3)]


def test_a_blocked_motion_from_free_space_is_not_executed(kinematics, monkeypatch):
    scanner = ViewpointScanner(Still(), kinematics)
    monkeypatch.setattr(scanner.motions, "free_path", lambda *_: None)
    with pytest.raises(PlanningError, match="none of 1 viewpoints can be reached: choose a nearer target"):
        scanner.capture(SCAN_VIEWPOINTS[:1])


def test_fewer_scan_views_are_subsets_in_order_and_grow():
    chosen = [scan_viewpoints(count) for count in range(1, 7)]
    assert chosen[-1] == SCAN_VIEWPOINTS
    for count, views in enumerate(chosen, start=1):
        assert len(views) == count and list(views) == [v for v in SCAN_VIEWPOINTS if v in views]
    assert all(set(fewer) < set(more) for fewer, more in itertools.pairwise(chosen))
