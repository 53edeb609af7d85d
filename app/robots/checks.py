"""Checks of an arm that need no simulation: hand, home, reach, viewpoints, camera; each takes a moment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from app.task.arm_cell import THINNEST_WALL, ArmCell
from manipulation.collision import CollisionWorld
from manipulation.kinematics import Kinematics
from manipulation.nearest_view import FULL_POSE
from manipulation.obstacles import TABLE
from manipulation.robot import ArmDescription
from manipulation.self_view import SelfView
from manipulation.viewpoints import FEW, viewpoint_ik
from manipulation.workspace import ENOUGH, ReachFit, Workspace, hand_down, hand_yaw
from perception.types import CATEGORIES, CameraIntrinsics

Verdict = Literal["good", "warning", "fault"]
RADII = np.arange(0.15, 1.21, 0.05)  # [m] from the base at which a vertical hand is tried
REACH_HEIGHT = 0.10  # [m] of the tool frame above the table
USABLE = 0.5  # share of the cell in reach below which no task can succeed
TILT = np.deg2rad(10)  # of the hand at home
MARGIN = 0.10  # [rad] of home from the joint limits
HIDDEN = 0.15, 0.60  # share of the image that the arm may cover, and that leaves too little


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


def check_hand(arm: ArmDescription) -> RobotFinding:
    """Return whether the hand opens for cans of 66 mm."""
    hand = arm.gripper
    found = f"opens from {1e3 * hand.min_width:.0f} to {1e3 * hand.max_width:.0f} mm, "
    found += f"fingertips {1e3 * hand.tip:.0f} mm beyond the tool frame, palm {1e3 * hand.palm:.0f} mm behind"
    if hand.max_width < 0.07:
        remedy = "wider cans and bottles cannot be packed; generated ones are smaller"
        return RobotFinding("warning", "hand", found, remedy)
    return RobotFinding("good", "hand", found)


def check_objects(arm: ArmDescription, cell: ArmCell) -> RobotFinding:
    """Return which classes the cell's objects are drawn from, and why not from all."""
    found = (
        f"objects are {', '.join(cell.categories)}, at {100 * cell.object_scale:.0f} % of their usual size"
    )
    if len(cell.categories) == len(CATEGORIES):
        return RobotFinding("good", "objects", found)
    missing = ", ".join(c for c in CATEGORIES if c not in cell.categories)
    if arm.gripper.min_width > THINNEST_WALL:
        found += (
            f"; the hand closes to {1e3 * arm.gripper.min_width:.0f} mm, too wide for the walls of {missing}"
        )
    else:
        thickness = 1e3 * arm.gripper.finger_thickness
        found += f"; fingers of {thickness:.0f} mm do not fit into {missing} of that size"
    return RobotFinding("warning", "objects", found, "other classes need a hand or an arm of another size")


def check_joints(arm: ArmDescription) -> RobotFinding:
    """Return whether the arm has joints enough to reach any pose near by."""
    count = len(arm.joint_names)
    if count >= FULL_POSE:
        return RobotFinding("good", "joints", f"{count} joints")
    found = (
        f"{count} joints: the hand stays vertical, and the camera takes the nearest view of each viewpoint"
    )
    return RobotFinding("warning", "joints", found, "walls that slope and objects that lie may be left")


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
    """Return the distances from the base [m] at which the hand, turned as at home, reaches down to 0.1 m."""
    yaw = hand_yaw(kinematics)
    reached = []
    for radius in RADII:
        T = hand_down((kinematics.base[0] + radius, kinematics.base[1], REACH_HEIGHT), yaw)
        if kinematics.inverse(T, kinematics.seeds_toward(T), name="the reach").converged:
            reached.append(float(radius))
    return np.array(reached)


def check_reach(reach: Float[np.ndarray, "r"], fit: ReachFit) -> RobotFinding:
    """Return whether the hand reaches the places of a cell, if need be of a smaller one."""
    if not len(reach):
        remedy = "move or turn the arm with [arm] base and base_yaw; check the direction of the tool frame"
        return RobotFinding(
            "fault", "reach", "the hand cannot point down to the table anywhere ahead", remedy
        )
    scale = fit.workspace.scale
    found = f"hand down to the table from {reach[0]:.2f} to {reach[-1]:.2f} m from the base; "
    found += f"{100 * fit.share:.0f} % of a cell of {100 * scale:.0f} % of the standard size in reach"
    if fit.share < USABLE:
        return RobotFinding("fault", "reach", found, "raise or move the arm: [arm] base")
    if fit.share < ENOUGH:
        return RobotFinding("warning", "reach", found, "raise or move the arm: [arm] base")
    return RobotFinding("good", "reach", found)


def check_viewpoints(kinematics: Kinematics, workspace: Workspace = Workspace()) -> RobotFinding:
    """Return how many of the scan's viewpoints the camera reaches."""
    viewpoints = (*workspace.scan_viewpoints(), *workspace.box_viewpoints)
    q = np.asarray(kinematics.arm.q_home, dtype=np.float64)
    count = sum(viewpoint_ik(kinematics, viewpoint, q) is not None for viewpoint in viewpoints)
    found = f"{count} of {len(viewpoints)} viewpoints of the scan are in reach"
    if kinematics.arm.near_views:
        found += " or seen from nearly their direction"
    if count < FEW:
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
    if share > HIDDEN[0]:
        verdict = "fault" if share > HIDDEN[1] else "warning"
        remedy = "move or turn [camera] site: z looks ahead, x to the right in the image"
        return RobotFinding(verdict, "camera", found, remedy)
    return RobotFinding("good", "camera", found + "; it is masked out")


def loading_faults(arm: ArmDescription, fovy: float, fit: ReachFit) -> list[RobotFinding]:
    """Return the faults that make every task with an arm fail."""
    kinematics = Kinematics(arm)
    reach = np.array([1.0]) if fit.share > 0 else np.zeros(0)
    findings = [*check_home(arm, kinematics), check_reach(reach, fit), check_camera(arm, fovy)]
    if fit.share >= USABLE:
        findings.append(check_viewpoints(kinematics, fit.workspace))
    return [finding for finding in findings if finding.verdict == "fault"]
