"""A robot file drafted from models: what can be found out is found out, what is assumed is written down."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from app.errors import UsageError
from app.robots.chain import Chain, find_chain
from app.robots.checks import USABLE
from app.robots.home import find_home
from manipulation.kinematics import Kinematics
from manipulation.robot import ArmDescription
from manipulation.workspace import ENOUGH, ReachFit, arm_workspace, fit_workspace
from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.hand_surface import geom_points
from sim_assets.robots.mounting import Frame, HandFile, Mount, compiled
from sim_assets.robots.robot_file import IDENTITY, RobotEntries, about_z, build_robot
from sim_assets.robots.servo_checks import can_follow
from sim_assets.robots.servos import DEFAULT_FORCE, joint_inertia, joint_servos, torque_limit
from sim_assets.robots.simulated_arm import SimulatedArm

ORIGIN = Frame(np.zeros(3), np.array(IDENTITY))
# Speeds that most arms follow: of the joints that carry the arm, and of the wrist.
VELOCITY, ACCELERATION, JERK = (1.6, 2.2), (4.0, 8.0), (250.0, 500.0)
LIFTS = (0.0, 0.1, 0.2, 0.3)  # [m] of the base above the table that are compared
BASE_TURNS = (0.0, np.pi, np.pi / 2, -np.pi / 2)  # [rad] of a base that are tried for a home posture
MAX_OFF_MIDDLE = 0.6  # [rad] of the first joint at home from the middle of its range
TORQUE_SHARE = 0.35  # of a joint's torque limit that acceleration may take


@dataclass(frozen=True)
class Draft:
    """A drafted robot file.

    Attributes:
        text: content of the file.
        assumptions: what was assumed, one sentence each.
    """

    text: str
    assumptions: tuple[str, ...]


def draft_robot(arm: Path, folder: Path, hand: Path | None = None, mount: str = "", root: str = "") -> Draft:
    """Draft the robot file of an arm.

    Args:
        arm: MJCF of the arm.
        folder: folder of the robot file, from which paths are relative.
        hand: MJCF of a hand of its own; None if the arm's file has one.
        mount: site or body of the arm that carries it.
        root: root body of the arm in a file with several.

    Raises:
        UsageError: the models are no arm with a parallel hand; the message names the remedy.
    """
    hand_file = None if hand is None else HandFile(hand, mount, ORIGIN)
    try:
        model = compiled(Mount(arm, ORIGIN, (), root, hand_file))
        chain = find_chain(model, root)
        entries = _entries(arm, hand_file, chain)
        model = compiled(entries.mount)
        entries = _placed(entries, model, chain)
        entries, robot, home = _homed(entries)
    except RobotFileError as error:
        raise UsageError("; ".join(error.problems)) from None
    lift = 0.0
    if home is not None:
        lift = best_lift(Kinematics(replace(robot.description, q_home=home)))
    if home is None or lift > 0:
        lift = lift or LIFTS[1]
        entries, robot, home = _homed(_raised(entries, lift))
    if home is None:
        raise UsageError(
            "no posture was found in which the hand points down in front of the base, free of collisions: "
            "check the direction of the hand, or give it a longer range of motion"
        )
    entries = replace(entries, home=home)
    raised = (f"the base stands {1e3 * lift:.0f} mm above the table, where it reaches most ([arm] base)",)
    remarks = (*(raised if lift else ()), *_reach_remarks(replace(robot.description, q_home=home)))
    guesses = (f"each finger presses with {DEFAULT_FORCE:g} N", "the limits of speed are moderate guesses")
    assumptions = (*chain.assumptions, *robot.assumptions, *remarks, *guesses)
    return Draft(_text(entries, folder, assumptions, model), assumptions)


def _homed(entries: RobotEntries) -> tuple[RobotEntries, SimulatedArm, np.ndarray | None]:
    """Return the entries, their arm and its home posture, if there is one.

    A base that reaches nothing ahead, or whose first joint is far from the middle of its range at home, is
    turned.
    """
    for turn in BASE_TURNS:
        ahead = _turned(entries, turn)
        robot = build_robot(ahead)
        kinematics = Kinematics(robot.description)
        home = find_home(robot.description, kinematics)
        if home is not None:
            break
    else:
        return entries, robot, None
    entries = ahead
    middle = 0.5 * float(kinematics.lower[0] + kinematics.upper[0])
    yaw = kinematics.base_turn * (float(home[0]) - middle)
    if abs(yaw) <= MAX_OFF_MIDDLE:
        return entries, robot, home
    entries = _turned(entries, yaw)
    return entries, build_robot(entries), np.array([middle, *home[1:]])


def _turned(entries: RobotEntries, yaw: float) -> RobotEntries:
    """Return the entries with the base turned about the first joint's axis by an angle in [rad]."""
    if yaw == 0:
        return entries
    base, c, s = entries.mount.base, np.cos(yaw), np.sin(yaw)
    position = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ base.position
    base = Frame(position, about_z(_angle(base.quaternion) + yaw))
    return replace(entries, mount=replace(entries.mount, base=base))


def _reach_remarks(arm: ArmDescription) -> Iterator[str]:
    """Yield that too little of a cell is in reach, with the usual cause."""
    share = arm_workspace(arm).share
    if share < USABLE:
        yield (
            f"only {100 * share:.0f} % of a cell is in reach with the hand pointing down, too little for any "
            "task: turn the hand at its mount ([hand] quaternion), or mount the arm otherwise ([arm] base)"
        )


def best_lift(kinematics: Kinematics) -> float:
    """Return the height [m] to raise an arm's base by: where its cell is largest and most in reach."""
    fits = [(lift, fit_workspace(kinematics, lift)) for lift in LIFTS]
    return min(fits, key=lambda pair: (-_worth(pair[1]), -pair[1].share, pair[0]))[0]


def _worth(fit: ReachFit) -> float:
    """Return the scale of a workspace, times the square of the share in reach if that is too small."""
    return fit.workspace.scale * (1.0 if fit.share >= ENOUGH else fit.share**2)


def _raised(entries: RobotEntries, lift: float) -> RobotEntries:
    base = entries.mount.base
    base = Frame(base.position + np.array([0.0, 0.0, lift]), base.quaternion)
    return replace(entries, mount=replace(entries.mount, base=base))


def _entries(arm: Path, hand: HandFile | None, chain: Chain) -> RobotEntries:
    """Return the entries without home and base."""
    count = len(chain.joints)
    wrist = np.arange(count) >= count - 3
    limits = np.array([np.where(wrist, fast, slow) for slow, fast in (VELOCITY, ACCELERATION, JERK)])
    return RobotEntries(
        mount=Mount(arm, ORIGIN, chain.joints, chain.root, hand),
        actuators=(), torque=None, home=np.zeros(count), limits=limits, fingers=chain.fingers, actuator="",
        commands=(0.0, 0.0, 0.0), force=DEFAULT_FORCE, geometry={}, tcp="", fovy=45.0,
    )  # fmt: skip


def _placed(entries: RobotEntries, model: MjModel, chain: Chain) -> RobotEntries:
    """Return the entries with the first joint's axis at the origin and the base standing on the table.

    Home is the middle of the joints' ranges for now; accelerations suit the torque limits. Servos of the
    model that are too soft or not damped are replaced by ones of the same torques.
    """
    ids = [model.joint(name).id for name in chain.joints]
    home = model.jnt_range[ids].mean(axis=1)
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[ids]] = home
    mujoco.mj_forward(model, data)
    lowest = _lowest_of_first_link(model, data, ids[0])
    carried = bool(chain.root) and int(model.body_parentid[model.body(chain.root).id]) > 0
    lift = -lowest if carried else max(-lowest, 0.0)  # without what carried it, the arm stands on the table
    anchor = data.xanchor[ids[0]]
    base = Frame(np.array([-anchor[0], -anchor[1], lift]) + 0.0, ORIGIN.quaternion)
    limits = entries.limits.copy()
    for index, (name, joint) in enumerate(zip(chain.joints, ids, strict=True)):
        torque = torque_limit(model, name)
        if torque:
            moment = joint_inertia(model, data, int(model.jnt_dofadr[joint]))
            limits[1, index] = np.clip(TORQUE_SHARE * torque / moment, 1.0, limits[1, index])
    torque = None
    if not can_follow(model, chain.joints):
        torque = np.array([servo.torque for servo in joint_servos(model, chain.joints, None)])
    mount = replace(entries.mount, base=base)
    return replace(entries, mount=mount, home=home, limits=limits, torque=torque)


def _lowest_of_first_link(model: MjModel, data: Any, first: int) -> float:
    """Return the height [m] of the first link's lowest collision point; 0 if it has none."""
    lowest = np.inf
    for geom in np.flatnonzero(model.geom_contype):
        body = model.geom_bodyid[geom]
        if model.body_weldid[body] == model.jnt_bodyid[first]:
            points = geom_points(model, int(geom)) @ data.geom_xmat[geom].reshape(3, 3).T
            lowest = min(lowest, float(points[:, 2].min() + data.geom_xpos[geom][2]))
    return lowest if np.isfinite(lowest) else 0.0


def _text(entries: RobotEntries, folder: Path, assumptions: Sequence[str], model: MjModel) -> str:
    mount = entries.mount
    yaw = _angle(mount.base.quaternion)
    lines = [
        "# Robot file drafted by `nodeslam robot init`. Metres, radians, seconds. Assumed:",
        *(f"# - {assumption}" for assumption in assumptions),
        "# Check it with `nodeslam doctor --robot FILE`.",
        f"mjcf = {_quoted(_relative(mount.mjcf, folder))}",
        "",
        "[arm]",
        *([f"body = {_quoted(mount.root)}"] if mount.root else []),
        f"joints = {_list(map(_quoted, mount.joints))} # hinges, base to wrist",
        f"home = {_numbers(entries.home)} # hand above the table, pointing down",
        f"velocity = {_numbers(entries.limits[0])} # limits of all motions",
        f"acceleration = {_numbers(entries.limits[1])}",
        f"jerk = {_numbers(entries.limits[2])}",
        *([] if entries.torque is None else [f"torque = {_numbers(entries.torque)} # of added servos"]),
        f"base = {_numbers(mount.base.position)} # the first joint's axis at the origin",
        *([f"base_yaw = {yaw:.4f} # the middle of the first joint's range looks ahead"] if yaw else []),
        "",
    ]
    if mount.hand is not None:
        lines += [
            "[hand]",
            f"mjcf = {_quoted(_relative(mount.hand.mjcf, folder))}",
            f"mount = {_quoted(mount.hand.mount)}",
            "",
        ]
    lines += [
        "[gripper]",
        f"joints = {_list(map(_quoted, entries.fingers))} # those that drive the fingers",
        f"force = {entries.force:g} # of each finger, in newtons; see the hand's data sheet",
        "",
    ]
    return "\n".join(lines)


def _angle(quaternion: np.ndarray) -> float:
    """Return the angle [rad] of a rotation about z."""
    return 2 * float(np.arctan2(quaternion[3], quaternion[0]))


def _relative(path: Path, folder: Path) -> str:
    return os.path.relpath(path.resolve(), folder.resolve())


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _numbers(values: np.ndarray) -> str:
    return _list(f"{round(float(value), 4) + 0.0}" for value in values)


def _list(items: Iterable[str]) -> str:
    return "[" + ", ".join(items) + "]"
