import numpy as np
import pytest

from app.task.restricted_robot import restricted
from manipulation.robot import DepthCamera, HandInMotion, JointTrajectory, Robot, RobotState

PROTOCOL = {
    name for part in (Robot, DepthCamera, HandInMotion) for name in vars(part) if not name.startswith("_")
}


class FullRobot:
    """A robot with members beyond the protocol, as the simulated one has."""

    arm = property(lambda self: pytest.importorskip("sim_assets.robots").panda().description)
    config = "objects"
    _data = "qpos"

    def state(self):
        return RobotState(1.5, self.joint_positions(), 0.03)

    def joint_positions(self):
        return np.arange(7.0)

    def gripper_width(self):
        return 0.03

    def follow(self, trajectory):
        self.followed = trajectory

    def move_gripper(self, width):
        return width / 2

    def capture(self):
        raise NotImplementedError("no camera")

    def stop(self, reason):
        self.stopped = reason

    def wait(self, duration):
        pass


def test_members_are_those_of_the_protocol():
    robot = restricted(FullRobot())
    assert {name for name in dir(robot) if not name.startswith("_")} == PROTOCOL
    assert isinstance(robot, Robot)


@pytest.mark.parametrize("name", ["config", "_data", "wait", "followed", "__dict__"])
def test_everything_else_is_out_of_reach(name):
    robot = restricted(FullRobot())
    with pytest.raises(AttributeError):
        getattr(robot, name)
    with pytest.raises(AttributeError):
        setattr(robot, name, None)


def test_no_attribute_refers_to_the_robot():
    full = FullRobot()
    robot = restricted(full)
    for name in PROTOCOL:
        assert getattr(getattr(robot, name), "__self__", None) is not full


def test_calls_are_forwarded():
    full = FullRobot()
    robot = restricted(full)
    np.testing.assert_array_equal(robot.joint_positions(), np.arange(7.0))
    assert robot.gripper_width() == 0.03
    assert robot.move_gripper(0.08) == 0.04
    still = np.zeros((1, 7))
    trajectory = JointTrajectory(0.01, still, still, still)
    robot.follow(trajectory)
    assert full.followed is trajectory
    robot.stop("a person is near")
    assert full.stopped == "a person is near" and robot.state().time == 1.5
    assert len(robot.arm.joint_names) == 7
    with pytest.raises(NotImplementedError, match="no camera"):
        robot.capture()
    with pytest.raises(NotImplementedError, match="no camera"):  # it has no cheaper depth images
        robot.capture_depth()
    full.capture_depth = lambda: 1 / 0
    with pytest.raises(ZeroDivisionError):
        robot.capture_depth()
