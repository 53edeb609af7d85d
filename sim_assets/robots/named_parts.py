"""Validation of the parts of an MJCF named by its robot file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.mounting import COLLISION_GROUP, Mount, load
from sim_assets.robots.simulated_arm import SimulatedArm

_TOLERANCE = 1e-4  # [m], [rad]


def compiled(path: Path, mount: Mount) -> MjModel:
    """Compile the arm alone.

    Raises:
        RobotFileError: its MJCF does not compile.
    """
    spec = load(mount)
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise RobotFileError(f"{path}: {mount.mjcf.name} does not compile: {error}") from None


def check_parts(path: Path, model: MjModel, robot: SimulatedArm) -> None:
    """Check that the arm is usable in a cell.

    Raises:
        RobotFileError: a part is missing or of the wrong kind.
    """
    problem = next(iter(_problems(model, robot)), None)
    if problem is not None:
        raise RobotFileError(f"{path}: {problem}")


def _problems(model: MjModel, robot: SimulatedArm) -> Iterator[str]:
    """Yield the problems, causes before consequences."""
    arm = robot.description
    wanted = {
        "joint": ((model.joint(i).name for i in range(model.njnt)), arm.joint_names + arm.finger_joint_names),
        "actuator": (
            (model.actuator(i).name for i in range(model.nu)),
            (*robot.actuators, robot.gripper_actuator),
        ),
        "site": ((model.site(i).name for i in range(model.nsite)), (arm.tcp_site, arm.camera_site)),
    }
    for kind, (there, names) in wanted.items():
        known = [name for name in there if name]
        missing = next((name for name in names if name not in known), None)
        if missing is not None:
            yield f"the MJCF has no {kind} '{missing}'; it has {', '.join(known) or 'none with a name'}"
    for name, home in zip(arm.joint_names, arm.q_home, strict=True):
        joint = model.joint(name)
        low, high = joint.range
        if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE or not model.jnt_limited[joint.id]:
            yield f"joint '{name}' must be a hinge with a range"
        if not low <= home <= high:
            yield f"[arm] home {home:g} of joint '{name}' is outside its range {low:.4g}..{high:.4g} rad"
    for name, joint in zip(robot.actuators, arm.joint_names, strict=True):
        if not _is_servo(model, name, joint):
            yield f"actuator '{name}' is no position servo (kp > 0, gear 1) of joint '{joint}'"
    for name in arm.finger_joint_names:
        joint, half = model.joint(name), arm.max_width / 2
        if joint.type[0] != mujoco.mjtJoint.mjJNT_SLIDE:
            yield f"finger joint '{name}' must slide"
        low, high = joint.range
        if model.jnt_limited[joint.id] and (abs(low) > _TOLERANCE or high < half - _TOLERANCE):
            yield (
                f"finger joint '{name}' slides over {low:.4g}..{high:.4g} m, expected 0 (pads meet) to "
                f"max_width / 2 = {half:.4g} m"
            )
    gripper = model.actuator(robot.gripper_actuator)
    low, high = gripper.ctrlrange
    for key, command in {"open": robot.open, "closed": robot.closed, "press": robot.press}.items():
        if model.actuator_ctrllimited[gripper.id] and not low <= command <= high:
            yield f"[gripper] {key} = {command:g} is outside the actuator's ctrlrange {low:g}..{high:g}"
    if robot.open == robot.closed:
        yield "[gripper] open and closed are the same command"
    yield from _shape_problems(model, robot)


def _shape_problems(model: MjModel, robot: SimulatedArm) -> Iterator[str]:
    names = [model.body(body).name for body in range(model.nbody)]
    if not all(names) or any("/" in name for name in names):
        yield "every body of the MJCF needs a name without '/'"
    solid = {int(body) for body in model.geom_bodyid[model.geom_group == COLLISION_GROUP]}
    moving = [body for body in range(model.nbody) if model.body_weldid[body]]
    if not solid.intersection(moving):
        yield 'no geom of the arm is in group 3: give the collision shapes group="3", as Menagerie does'
    for name in robot.description.finger_joint_names:
        finger = int(model.joint(name).bodyid[0])
        if not any(_is_below(model, body, finger) for body in solid):
            yield f"no geom in group 3 on the finger that joint '{name}' moves: it could not hold anything"


def _is_below(model: MjModel, body: int, ancestor: int) -> bool:
    while body and body != ancestor:
        body = int(model.body_parentid[body])
    return body == ancestor


def _is_servo(model: MjModel, name: str, joint: str) -> bool:
    index = model.actuator(name).id
    gain, bias = model.actuator_gainprm[index, 0], model.actuator_biasprm[index]
    return bool(
        model.actuator_trntype[index] == mujoco.mjtTrn.mjTRN_JOINT
        and model.actuator_trnid[index, 0] == model.joint(joint).id
        and model.actuator_gaintype[index] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_AFFINE
        and gain > 0
        and np.isclose(bias[1], -gain)
        and bias[2] <= 0
        and model.actuator_gear[index, 0] == 1
    )
