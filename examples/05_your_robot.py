"""Drive your own arm: implement the protocol Robot; planning and execution know nothing else of it.

python examples/05_your_robot.py [ROBOT.toml]
"""

import sys

import numpy as np

import nodeslam


class MyArm:
    """Your arm behind the protocol; `driver` stands for its driver (here the simulated cell)."""

    def __init__(self, arm: nodeslam.ArmDescription, driver: nodeslam.World) -> None:
        self.arm, self.driver = arm, driver

    def state(self) -> nodeslam.RobotState:
        return self.driver.state()  # with the time of the measurement, on the clock of the images

    def joint_positions(self) -> np.ndarray:
        return self.driver.joint_positions()

    def gripper_width(self) -> float:
        return self.driver.gripper_width()

    def follow(self, trajectory: nodeslam.JointTrajectory) -> None:
        self.driver.follow(trajectory)  # positions, velocities, accelerations every `period` s

    def move_gripper(self, width: float) -> float:
        return self.driver.move_gripper(width)

    def capture(self) -> nodeslam.RgbdFrame:
        return self.driver.capture()  # colour, registered depth, and T_world_camera by forward kinematics

    def stop(self, reason: str) -> None:
        self.driver.stop(reason)  # called from any thread; no substitute for an emergency stop


model = nodeslam.load_robot(sys.argv[1] if len(sys.argv) > 1 else "sixaxis")
objects = nodeslam.draw_objects({"can": 1}, "test", np.random.default_rng(0))
with nodeslam.World(nodeslam.CellConfig(objects, seed=1, robot=model)) as cell:
    robot = MyArm(model.description, cell)
    assert isinstance(robot, nodeslam.Robot)
    frames = nodeslam.ViewpointScanner(robot, nodeslam.Kinematics(robot.arm)).capture(
        nodeslam.SCAN_VIEWPOINTS[:3]
    )
    scene = nodeslam.reconstruct(frames)
    plan = nodeslam.plan_pack(scene.objects, nodeslam.Box(), robot.arm)
    outcomes = nodeslam.execute(plan, robot)
for outcome in outcomes:
    print(f"{outcome.name}: {'packed' if outcome.placed else outcome.reason}, {outcome.attempts} attempts")
