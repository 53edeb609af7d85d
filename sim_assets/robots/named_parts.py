"""Checks of an arm against the entries of its robot file; each problem is one line that names the remedy."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.finger_motion import hand_joints, is_below
from sim_assets.robots.servo_checks import servo_problems
from sim_assets.robots.servos import is_servo
from sim_assets.robots.simulated_arm import SimulatedArm

if TYPE_CHECKING:
    from sim_assets.robots.hand_surface import HandShape
    from sim_assets.robots.robot_file import RobotEntries

MIN_FORCE = 10.0  # [N] of each finger, for objects of half a kilogram at friction 0.5 with reserve
MIN_OPENING = 0.02  # [m] between the pads
WIDTH_TOLERANCE = 1e-3  # [m] of a stated opening beyond the measured one
_DIMENSION = 0.06  # [m] by which a stated dimension of the hand may differ from the measured one
_SHIFT = 0.06  # [m], the same of the tool frame
_AXIS = np.cos(np.deg2rad(25))  # and of its axes
_LISTED = 12  # names in a message


def part_problems(model: MjModel, entries: RobotEntries) -> list[str]:
    """Return the problems with the parts that the file names, causes before consequences."""
    mount = entries.mount
    joints = [name for name in (*mount.joints, *entries.fingers) if name]
    actuators = [name for name in (*entries.actuators, entries.actuator) if name]
    sites = [name for name in (entries.tcp, mount.camera_site) if name]
    problems = [
        *_missing("joint", [model.joint(i).name for i in range(model.njnt)], joints),
        *_missing("actuator", [model.actuator(i).name for i in range(model.nu)], actuators),
        *_missing("site", [model.site(i).name for i in range(model.nsite)], sites),
    ]
    if problems or not mount.joints:
        return problems
    problems += _chain_problems(model, mount.joints)
    if len(entries.home) == len(mount.joints):
        problems += _home_problems(model, mount.joints, entries.home)
    for name, joint in zip(entries.actuators, mount.joints, strict=False):
        if not _drives(model, name, joint):
            problems.append(
                f"actuator '{name}' is no position servo (kp > 0, gear 1) of joint '{joint}': name another, "
                "or leave out [arm] actuators and servos are added"
            )
    if entries.actuator:
        problems += _command_problems(model, entries)
    last = int(model.joint(mount.joints[-1]).bodyid[0])
    if mount.camera_site and not is_below(model, int(model.site(mount.camera_site).bodyid[0]), last):
        problems.append(
            f"[camera] site '{mount.camera_site}' does not move with the hand: place it on the body of "
            f"'{mount.joints[-1]}' or below"
        )
    return [*problems, *_finger_problems(model, entries)]


def _missing(kind: str, known: Sequence[str], names: Sequence[str]) -> Iterator[str]:
    named = [name for name in known if name]
    shown = ", ".join(named[:_LISTED]) + (", ..." if len(named) > _LISTED else "")
    for name in names:
        if name not in named:
            yield f"the MJCF has no {kind} '{name}'; it has {shown or 'none with a name'}"


def _chain_problems(model: MjModel, joints: Sequence[str]) -> Iterator[str]:
    ids = [model.joint(name).id for name in joints]
    for before, after in itertools.pairwise(ids):
        if not is_below(model, int(model.jnt_bodyid[after]), int(model.jnt_bodyid[before])):
            yield (
                f"joint '{model.joint(after).name}' is not below '{model.joint(before).name}': list [arm] "
                "joints from base to wrist"
            )
            return
    last = int(model.jnt_bodyid[ids[-1]])
    yield from _held_problems(model, ids, last)
    hand = hand_joints(model, joints)
    for joint in range(model.njnt):
        if joint in ids or joint in hand:
            continue
        name = model.joint(joint).name
        if is_below(model, last, int(model.jnt_bodyid[joint])):
            yield f"joint '{name}' moves the arm but is not in [arm] joints: list it, or remove it"
        else:
            root = model.body(model.body_rootid[last]).name
            yield f"joint '{name}' belongs to another part: keep the arm alone with [arm] body = \"{root}\""


def _held_problems(model: MjModel, arm: Sequence[int], last: int) -> Iterator[str]:
    """Yield the equality constraints that keep the arm from moving freely; those within the hand are fine."""
    types = mujoco.mjtEq
    for index in range(model.neq):
        first, second = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
        if model.eq_type[index] == types.mjEQ_JOINT:
            holds = first in arm or second in arm
        elif model.eq_type[index] == types.mjEQ_WELD or model.eq_type[index] == types.mjEQ_CONNECT:
            if model.eq_objtype[index] == mujoco.mjtObj.mjOBJ_SITE:
                first, second = (int(model.site_bodyid[site]) for site in (first, second))
            holds = is_below(model, first, last) != is_below(model, second, last)
        else:
            continue
        if holds:
            name = model.equality(index).name or f"number {index + 1}"
            yield f"the equality constraint {name} holds the arm: remove it from the MJCF"


def _home_problems(model: MjModel, joints: Sequence[str], home: np.ndarray) -> Iterator[str]:
    for name, angle in zip(joints, home, strict=True):
        joint = model.joint(name)
        low, high = joint.range
        if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE or not model.jnt_limited[joint.id]:
            yield f"joint '{name}' must be a hinge with a range"
        elif not low <= angle <= high:
            yield f"[arm] home {angle:g} of joint '{name}' is outside its range {low:.4g}..{high:.4g} rad"


def _drives(model: MjModel, name: str, joint: str) -> bool:
    index = model.actuator(name).id
    return bool(
        model.actuator_trntype[index] == mujoco.mjtTrn.mjTRN_JOINT
        and model.actuator_trnid[index, 0] == model.joint(joint).id
        and is_servo(model, index)
    )


def _command_problems(model: MjModel, entries: RobotEntries) -> Iterator[str]:
    gripper = model.actuator(entries.actuator)
    low, high = gripper.ctrlrange
    for key, command in zip(("open", "closed", "press"), entries.commands, strict=True):
        if model.actuator_ctrllimited[gripper.id] and not low <= command <= high:
            yield f"[gripper] {key} = {command:g} is outside the actuator's ctrlrange {low:g}..{high:g}"
    if entries.commands[0] == entries.commands[1]:
        yield "[gripper] open and closed are the same command"


def _finger_problems(model: MjModel, entries: RobotEntries) -> Iterator[str]:
    below = hand_joints(model, entries.mount.joints)
    for name in entries.fingers:
        joint = model.joint(name)
        if joint.id not in below:
            yield f"finger joint '{name}' is not below the arm's last joint '{entries.mount.joints[-1]}'"
        elif not model.jnt_limited[joint.id]:
            yield f"finger joint '{name}' needs a range, from closed to open"
    last = int(model.joint(entries.mount.joints[-1]).bodyid[0])
    solid = {int(body) for body in model.geom_bodyid[model.geom_contype != 0]}
    if not any(is_below(model, body, last) for body in solid):
        yield ("the hand has no collision geoms (group 3, or contype and conaffinity), nothing to hold with")
    if not any(is_below(model, body, int(model.joint(entries.mount.joints[0]).bodyid[0])) for body in solid):
        yield "no geom of the arm is a collision geom: give the collision shapes group 3"


def robot_problems(model: MjModel, robot: SimulatedArm) -> list[str]:
    """Return the problems of an arm that is complete: its servos, its stated hand, its grip."""
    arm = robot.description
    problems = list(servo_problems(model, robot))
    measured = float(arm.fingers.widths[-1])
    if arm.max_width < MIN_OPENING:
        problems.append(
            f"the fingers open to {arm.max_width:g} m, too little for any object (at least "
            f"{MIN_OPENING:g} m): leave out [gripper] max_width, or name the joints that open the hand"
        )
    if arm.max_width > measured + WIDTH_TOLERANCE:
        problems.append(
            f"[gripper] max_width = {arm.max_width:g} m, but the pads open to {measured:.4f} m: leave it out"
        )
    force = grip_force(model, robot)
    if force < MIN_FORCE:
        problems.append(
            f"the fingers press with {force:.1f} N, too little to hold a can (at least {MIN_FORCE:g} N): "
            "raise the actuator's force or press, or give force in place of actuator, open and closed"
        )
    return problems


def stated_hand_problems(model: MjModel, entries: RobotEntries, hand: HandShape) -> Iterator[str]:
    """Yield what the file states about the hand that differs from what was measured on the model."""
    geometry = replace(hand.geometry, **entries.geometry)
    if geometry.min_width >= geometry.max_width:
        yield (
            f"[gripper] max_width = {geometry.max_width:g} m must be above the closed hand's "
            f"{geometry.min_width:.4f} m"
        )
    shift = 0.0
    if entries.tcp:
        site = model.site(entries.tcp)
        T_body_tool = _in_body(model, int(site.id), hand.body)
        if T_body_tool is None:
            yield f"[gripper] tcp '{entries.tcp}' is not on the hand, below '{entries.mount.joints[-1]}'"
            return
        if geometry.one_jaw:
            yield "[gripper] tcp lies on the fixed one of two jaws: leave it out, it is measured"
            return
        turn = hand.T_body_tcp[:3, :3].T @ T_body_tool[:3, :3]
        if turn[2, 2] < _AXIS or abs(turn[1, 1]) < _AXIS:
            yield (
                "[gripper] tcp must have z out of the hand and y along the closing direction, within 25 "
                "degrees of the measured ones: turn it, or leave it out and it is measured"
            )
        shift = float(np.linalg.norm(hand.T_body_tcp[:3, 3] - T_body_tool[:3, 3]))
        if shift > _SHIFT:
            yield (
                f"[gripper] tcp is {1e3 * shift:.0f} mm from the middle of the pads: move it, or leave it out"
            )
    for name, stated in entries.geometry.items():
        measured = float(getattr(hand.geometry, name))
        if name != "max_width" and abs(stated - measured) > _DIMENSION + shift:
            yield f"[gripper] {name} = {stated:g} m, but {measured:.3f} m on the model: leave it out"


def _in_body(model: MjModel, site: int, body: str) -> np.ndarray | None:
    """Return a site's pose in a body that carries it, its joints at zero; None if the body does not."""
    if not is_below(model, int(model.site_bodyid[site]), model.body(body).id):
        return None
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    poses = []
    for R, p in ((data.body(body).xmat, data.body(body).xpos), (data.site_xmat[site], data.site_xpos[site])):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.reshape(3, 3), p
        poses.append(T)
    return np.linalg.inv(poses[0]) @ poses[1]


def grip_force(model: MjModel, robot: SimulatedArm) -> float:
    """Return the force [N] of each finger on an object of half the largest opening, at full command.

    By the principle of virtual work, from the actuator's force and the change of the opening with its length.
    """
    fingers = robot.description.fingers
    middle = 0.5 * (fingers.widths[0] + fingers.widths[-1])
    step = 0.02 * float(np.ptp(fingers.widths))
    lengths = [_actuator_length(model, robot, fingers.at(w)) for w in (middle - step, middle, middle + step)]
    rate = (lengths[2] - lengths[0]) / (2 * step)
    index = model.actuator(robot.gripper_actuator).id
    gain, bias = model.actuator_gainprm[index], model.actuator_biasprm[index]
    push = gain[0] * robot.press + bias[0] + bias[1] * lengths[1]
    if model.actuator_forcelimited[index]:
        push = float(np.clip(push, *model.actuator_forcerange[index]))
    return float(-push * rate)


def _actuator_length(model: MjModel, robot: SimulatedArm, position: np.ndarray) -> float:
    data = mujoco.MjData(model)
    for name, value in zip(robot.description.fingers.joint_names, position, strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_forward(model, data)
    return float(data.actuator(robot.gripper_actuator).length[0])
