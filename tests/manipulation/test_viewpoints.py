import numpy as np
import pytest

from manipulation.collision import CollisionWorld
from manipulation.errors import PlanningError
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE
from manipulation.viewpoints import (
    BOX_VIEWPOINTS,
    KEEP_OUT,
    LINE_VIEWPOINTS,
    ROLLS,
    SCAN_VIEWPOINTS,
    Viewpoint,
    ViewpointScanner,
    closeup_viewpoints,
    viewpoint_ik,
)
from perception.types import CameraIntrinsics, RgbdFrame
from sim_assets.robots.panda_arm import arm_description


@pytest.fixture(scope="module")
def kinematics():
    return Kinematics(arm_description())


@pytest.mark.parametrize("roll", ROLLS)
def test_the_camera_looks_at_its_target_from_its_distance(roll):
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
def test_the_scripted_views_are_within_reach(kinematics, views):
    q = np.array(kinematics.arm.q_home)
    for view in views:
        found = viewpoint_ik(kinematics, view, q)
        assert found is not None
        T = kinematics.forward(found, "camera")
        np.testing.assert_allclose(T[:3, 3], view.camera_pose()[:3, 3], atol=2e-4)
        np.testing.assert_allclose(T[:3, 2], view.camera_pose()[:3, 2], atol=2e-3)
        q = found


class Moving:
    """A robot that only remembers where it went."""

    arm = arm_description()

    def __init__(self, q):
        self.q, self.tracks = np.array(q), []

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
def test_no_look_leads_through_the_space_of_objects(kinematics, views):
    robot = Moving(kinematics.arm.q_home)
    assert len(ViewpointScanner(robot, kinematics).capture(views)) == len(views)
    world = CollisionWorld(robot.arm, [], (TABLE, *KEEP_OUT))
    assert all(world.path_contact(track[::10], 0.08) is None for track in robot.tracks)


def test_a_look_that_begins_among_objects_leaves_them_first(kinematics):
    low = kinematics.forward(np.array(kinematics.arm.q_home))
    low[:3, 3] = (0.45, -0.25, 0.2)
    robot = Moving(kinematics.inverse(low, kinematics.seeds_toward(low, 3)).q)
    assert len(ViewpointScanner(robot, kinematics).capture(SCAN_VIEWPOINTS)) == len(SCAN_VIEWPOINTS)


class Still:
    """A robot that stays where it is; nothing here gets as far as moving it."""

    arm = arm_description()

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


def test_looking_where_the_arm_cannot_go_is_an_error(kinematics):
    with pytest.raises(PlanningError, match="none of 2 viewpoints can be reached"):
        ViewpointScanner(Still(), kinematics).capture(closeup_viewpoints((2.0, 0.0, 0.0)))
