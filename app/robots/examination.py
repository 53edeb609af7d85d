"""Findings about an arm: what its file and models say, and what a short simulated test shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from app.robots.checks import (
    RobotFinding,
    check_camera,
    check_hand,
    check_home,
    check_joints,
    check_objects,
    check_reach,
    check_viewpoints,
    reachable_radii,
)
from app.task.arm_cell import payload, scales_of
from manipulation.errors import RobotError
from manipulation.kinematics import Kinematics
from manipulation.trajectories import JointLimits, MotionConfig, joint_move
from manipulation.workspace import ReachFit, fit_workspace
from sim_assets.cell.config import CellConfig
from sim_assets.cell.world import World
from sim_assets.robots.simulated_arm import SimulatedArm

SWING = 0.35  # [rad] of each joint in the test of the servos
TRACKING = 0.03, 0.10  # [rad] of error beyond which servos are slow, and unusable
GRIP_TOLERANCE = 0.006  # [m] that springs of a linkage may hold back
HEAVY = 0.6  # [kg], the heaviest objects


@dataclass(frozen=True)
class Examination:
    """All findings, with what the picture shows.

    Attributes:
        findings: in the order of the checks.
        reach: distances from the base in [m] that a hand pointing down reaches.
        fit: the cell that suits the arm.
    """

    findings: tuple[RobotFinding, ...]
    reach: Float[np.ndarray, "r"]
    fit: ReachFit


def examine_robot(robot: SimulatedArm) -> Examination:
    """Examine an arm in an empty cell; takes about half a minute."""
    arm = robot.description
    kinematics = Kinematics(arm)
    reach, fit = reachable_radii(kinematics), fit_workspace(kinematics)
    findings = [
        *(RobotFinding("good", "assumed", text) for text in robot.assumptions),
        check_hand(arm),
        check_joints(arm),
        check_objects(arm, scales_of(fit, robot)),
        *check_home(arm, kinematics),
        check_reach(reach, fit),
        check_viewpoints(kinematics, fit.workspace),
        check_camera(arm, robot.fovy),
    ]
    with World(CellConfig(objects=(), box=None, robot=robot, scale=fit.workspace.scale)) as world:
        findings += [check_grip(world), check_payload(world), check_servos(world)]
    return Examination(tuple(findings), reach, fit)


def check_grip(world: World) -> RobotFinding:
    """Return whether the hand closes and opens in the simulation."""
    closed, opened = world.move_gripper(0.0), world.move_gripper(world.arm.max_width)
    found = f"closes to {1e3 * closed:.1f} mm and opens to {1e3 * opened:.1f} mm"
    short, wide = world.arm.max_width - opened, closed - world.arm.gripper.min_width
    if short > GRIP_TOLERANCE or wide > GRIP_TOLERANCE:
        return RobotFinding("fault", "gripper", found, "check [gripper] joints, force, open and closed")
    return RobotFinding("good", "gripper", found)


def check_payload(world: World) -> RobotFinding:
    """Return whether the arm holds the heaviest objects at full reach."""
    load = payload(world)
    found = f"lifts {load:.1f} kg at full reach, by torque and grip"
    if load < HEAVY:
        remedy = "heavier objects may be dropped: give [arm] torque and [gripper] force of the data sheets"
        return RobotFinding("warning", "payload", found, remedy)
    return RobotFinding("good", "payload", found)


def check_servos(world: World) -> RobotFinding:
    """Swing all joints at the stated limits; return the largest tracking error."""
    q = world.joint_positions()
    kinematics = Kinematics(world.arm)
    sign = np.where(q + SWING < kinematics.upper - 0.05, 1.0, -1.0)
    sign[1] = (
        -sign[1] if kinematics.forward(q + SWING * sign)[2, 3] < kinematics.forward(q)[2, 3] else sign[1]
    )
    trajectory = joint_move(q, q + SWING * sign, JointLimits.of(world.arm, MotionConfig()))
    start, worst = world.time, np.zeros(len(q))
    times = trajectory.period * np.arange(len(trajectory.positions))

    def compare(cell: World) -> None:
        wanted = [np.interp(cell.time - start, times, column) for column in trajectory.positions.T]
        np.maximum(worst, np.abs(cell.joint_positions() - wanted), out=worst)

    world.observe(compare, fps=200.0)
    try:
        world.follow(trajectory)
    except RobotError as error:
        return RobotFinding("fault", "servos", str(error), "lower [arm] acceleration, or give [arm] torque")
    finally:
        world.observe(None)
    joint = world.arm.joint_names[int(worst.argmax())]
    found = f"follow to {1e3 * worst.max():.1f} mrad at the stated limits (worst: {joint})"
    if worst.max() > TRACKING[0]:
        verdict = "fault" if worst.max() > TRACKING[1] else "warning"
        remedy = "lower [arm] velocity and acceleration, or leave out actuators and give torque"
        return RobotFinding(verdict, "servos", found, remedy)
    return RobotFinding("good", "servos", found)
