"""Findings about an arm: what its file and models say, and what a short simulated test shows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from manipulation.collision import CollisionWorld
from manipulation.errors import RobotError
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE
from manipulation.robot import ArmDescription
from manipulation.self_view import SelfView
from manipulation.trajectories import JointLimits, MotionConfig, joint_move
from manipulation.viewpoints import BOX_VIEWPOINTS, SCAN_VIEWPOINTS, viewpoint_ik
from perception.types import CameraIntrinsics
from sim_assets.cell.world import CellConfig, World
from sim_assets.robots.simulated_arm import SimulatedArm

Verdict = Literal["good", "warning", "fault"]
RADII = np.arange(0.15, 1.21, 0.05)  # [m] from the base at which a vertical hand is tried
REACH_HEIGHT = 0.10  # [m] of the tool frame above the table
REGION = (0.30, 0.70)  # [m] from the base: where the cell's objects lie
TILT = np.deg2rad(10)  # of the hand at home
MARGIN = 0.10  # [rad] of home from the joint limits
SWING = 0.35  # [rad] of each joint in the test of the servos
TRACKING = 0.03, 0.10  # [rad] of error beyond which servos are slow, and unusable


@dataclass(frozen=True)
class RobotFinding:
    """One finding.

    Attributes:
        verdict: "good", "warning" or "fault" (the task cannot succeed).
        subject: what was examined.
        found: what was found.
        remedy: what to do unless the verdict is "good".
    """

    verdict: Verdict
    subject: str
    found: str
    remedy: str = ""


@dataclass(frozen=True)
class Examination:
    """All findings, with what the picture shows.

    Attributes:
        findings: in the order of the checks.
        reach: distances from the base in [m] that a hand pointing down reaches.
    """

    findings: tuple[RobotFinding, ...]
    reach: Float[np.ndarray, "r"]


def examine_robot(robot: SimulatedArm) -> Examination:
    """Examine an arm in an empty cell; takes about half a minute."""
    arm = robot.description
    kinematics = Kinematics(arm)
    reach = reachable_radii(kinematics)
    findings = [
        *(RobotFinding("good", "assumed", text) for text in robot.assumptions),
        check_hand(arm),
        *check_home(arm, kinematics),
        check_reach(reach),
        check_viewpoints(kinematics),
        check_camera(arm, robot.fovy),
    ]
    with World(CellConfig(objects=(), box=None, robot=robot)) as world:
        findings += [check_grip(world), check_servos(world)]
    return Examination(tuple(findings), reach)


def check_hand(arm: ArmDescription) -> RobotFinding:
    """Return whether the opening suits the cell's objects: walls of 2 mm to cans of 66 mm."""
    hand = arm.gripper
    found = f"opens from {1e3 * hand.min_width:.0f} to {1e3 * hand.max_width:.0f} mm, "
    found += f"fingertips {1e3 * hand.tip:.0f} mm beyond the tool frame, palm {1e3 * hand.palm:.0f} mm behind"
    if hand.max_width < 0.07:
        remedy = "cans and bottles wider than the hand cannot be packed: --objects mug=2,bowl=2"
        return RobotFinding("warning", "hand", found, remedy)
    if hand.min_width > 0.003:
        return RobotFinding("warning", "hand", found, "thin rims of mugs and bowls cannot be held")
    return RobotFinding("good", "hand", found)


def check_home(arm: ArmDescription, kinematics: Kinematics) -> Iterator[RobotFinding]:
    """Yield what is wrong with the home posture; one good finding if nothing is."""
    q = np.asarray(arm.q_home, dtype=np.float64)
    T = kinematics.forward(q)
    place = f"hand at ({T[0, 3]:.2f}, {T[1, 3]:.2f}, {T[2, 3]:.2f}) m"
    contact = CollisionWorld(arm, [], (TABLE,)).contact(q, arm.max_width)
    faults = []
    if contact is not None:
        faults.append(
            ("fault", f"{contact.link or 'the arm'} touches {contact.obstacle}", "change [arm] home")
        )
    tilt = float(np.arccos(np.clip(-T[2, 2], -1, 1)))
    if tilt > TILT:
        remedy = "choose [arm] home with the hand pointing down; the planner starts from it"
        faults.append(("warning", f"the hand is tilted by {np.rad2deg(tilt):.0f} degrees", remedy))
    margin = kinematics.limit_distance(q)
    if margin < MARGIN:
        index = int(np.minimum(q - kinematics.lower, kinematics.upper - q).argmin())
        found = f"{arm.joint_names[index]} is {margin:.2f} rad from its limit"
        faults.append(("warning", found, f"choose [arm] home at least {MARGIN} rad inside all limits"))
    for verdict, found, remedy in faults:
        yield RobotFinding(verdict, "home", f"{place}; {found}", remedy)
    if not faults:
        yield RobotFinding("good", "home", f"{place}, free, {margin:.2f} rad from the joint limits")


def reachable_radii(kinematics: Kinematics) -> Float[np.ndarray, "r"]:
    """Return the distances from the base [m] at which the hand reaches down to 0.1 m, ahead of the arm."""
    reached = []
    for radius in RADII:
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, 3] = kinematics.base[0] + radius, kinematics.base[1], REACH_HEIGHT
        if kinematics.inverse(T, kinematics.seeds_toward(T), name="the reach").converged:
            reached.append(float(radius))
    return np.array(reached)


def check_reach(reach: Float[np.ndarray, "r"]) -> RobotFinding:
    """Return whether the hand reaches the places of the cell's objects."""
    remedy = "move or turn the arm with [arm] base and base_yaw; check the direction of the tool frame"
    if not len(reach):
        return RobotFinding(
            "fault", "reach", "the hand cannot point down to the table anywhere ahead", remedy
        )
    found = f"hand down to the table from {reach[0]:.2f} to {reach[-1]:.2f} m from the base"
    if reach[0] > REGION[0] + 0.05 or reach[-1] < REGION[1] - 0.05:
        found += f"; the cell's objects lie at {REGION[0]:.2f} to {REGION[1]:.2f} m"
        return RobotFinding("warning", "reach", found, "objects outside are left; " + remedy)
    return RobotFinding("good", "reach", found)


def check_viewpoints(kinematics: Kinematics) -> RobotFinding:
    """Return how many of the scan's viewpoints the camera reaches."""
    viewpoints = (*SCAN_VIEWPOINTS, *BOX_VIEWPOINTS)
    q = np.asarray(kinematics.arm.q_home, dtype=np.float64)
    count = sum(viewpoint_ik(kinematics, viewpoint, q) is not None for viewpoint in viewpoints)
    found = f"{count} of {len(viewpoints)} viewpoints of the scan are in reach"
    if count < 4:
        return RobotFinding("fault", "viewpoints", found, "mount the camera otherwise: [camera] site")
    verdict = "good" if count == len(viewpoints) else "warning"
    return RobotFinding(verdict, "viewpoints", found, "the others are skipped")


def check_camera(arm: ArmDescription, fovy: float) -> RobotFinding:
    """Return the share of the wrist camera's image that the arm itself covers at home."""
    focal = 240 / np.tan(np.deg2rad(fovy) / 2)
    intrinsics = CameraIntrinsics(fx=focal, fy=focal, cx=319.5, cy=239.5, width=640, height=480)
    view = SelfView(arm)
    share = float(np.isfinite(view.depth(arm.q_home, arm.max_width, intrinsics)).mean())
    found = f"the arm covers {100 * share:.0f} % of the image at home"
    if share > 0.15:
        return RobotFinding("warning", "camera", found, "move [camera] site away from the fingers")
    return RobotFinding("good", "camera", found + "; it is masked out")


def check_grip(world: World) -> RobotFinding:
    """Return whether the hand closes and opens in the simulation."""
    closed, opened = world.move_gripper(0.0), world.move_gripper(world.arm.max_width)
    found = f"closes to {1e3 * closed:.1f} mm and opens to {1e3 * opened:.1f} mm"
    if opened < world.arm.max_width - 0.004 or closed > world.arm.gripper.min_width + 0.004:
        return RobotFinding("fault", "gripper", found, "check [gripper] joints, force, open and closed")
    return RobotFinding("good", "gripper", found)


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
