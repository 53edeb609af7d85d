"""Motion of a hand's joints over its range, found by moving the fingers in the hand's own model.

Sliding fingers and linkages alike: stiff springs pull the driven joints through their range, and MuJoCo's
equality constraints make the others follow. Contacts, gravity and actuators are off meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.servos import is_servo

_STATIONS = 13  # positions over the range
_FINE_STATIONS = 61  # of a single joint
_STEPS = 150  # of 2 ms at each, for the linkage to settle
_UNEQUAL = 1.2  # ratio of the ranges of two driven joints from which on those of their commands count
_FREQUENCY = 100.0  # [rad/s] of the springs
_ARMATURE = {int(mujoco.mjtJoint.mjJNT_SLIDE): 0.1, int(mujoco.mjtJoint.mjJNT_HINGE): 1e-3}  # [kg], [kg m^2]


@dataclass(frozen=True)
class HandSweep:
    """Joint positions of a hand while its fingers move through their range.

    Attributes:
        joint_names: names of the hand's m joints, the driven ones first.
        positions: (k, m) their positions at each station, in [m] or [rad].
        qpos: (k, nq) state of the whole model at each station.
        n_driven: number of driven joints.
    """

    joint_names: tuple[str, ...]
    positions: Float[np.ndarray, "k m"]
    qpos: Float[np.ndarray, "k nq"]
    n_driven: int


def hand_joints(model: MjModel, arm_joints: Sequence[str]) -> list[int]:
    """Return the joints below the last arm joint."""
    last = int(model.joint(arm_joints[-1]).bodyid[0])
    arm = {model.joint(name).id for name in arm_joints}
    return [j for j in range(model.njnt) if j not in arm and is_below(model, int(model.jnt_bodyid[j]), last)]


def is_below(model: MjModel, body: int, ancestor: int) -> bool:
    """Return whether a body is ``ancestor`` or attached to it."""
    while body and body != ancestor:
        body = int(model.body_parentid[body])
    return body == ancestor


def sweep_hand(model: MjModel, arm_joints: Sequence[str], driven: Sequence[str]) -> HandSweep:
    """Move the driven joints through their range, the arm at its zero posture clipped to its limits.

    Args:
        model: compiled from the arm with its hand; unchanged.
        arm_joints: names of the arm's joints, base to wrist.
        driven: names of the one or two driven finger joints.

    Raises:
        RobotFileError: a driven joint has no range.
    """
    ids = [model.joint(name).id for name in driven]
    unlimited = [name for name, j in zip(driven, ids, strict=True) if not model.jnt_limited[j]]
    if unlimited:
        raise RobotFileError(f"finger joint '{unlimited[0]}' needs a range, from closed to open")
    others = [j for j in hand_joints(model, arm_joints) if j not in ids]
    if len(ids) == 1 and not others:
        return _swept_alone(model, arm_joints, ids[0])
    copy = _loosened(model, arm_joints, ids)
    data = mujoco.MjData(copy)
    arm = [model.joint(name).id for name in arm_joints]
    data.qpos[model.jnt_qposadr[arm]] = np.clip(0.0, *model.jnt_range[arm].T)
    ends = _ordered_ends(copy, data, ids)
    found = []
    for share in np.linspace(0, 1, _STATIONS):
        copy.qpos_spring[model.jnt_qposadr[ids]] = ends[:, 0] + share * (ends[:, 1] - ends[:, 0])
        for _ in range(_STEPS if found else 3 * _STEPS):
            mujoco.mj_step(copy, data)
        found.append(data.qpos.copy())
    qpos = np.array(found)
    order = [*ids, *others]
    names = tuple(model.joint(j).name for j in order)
    return HandSweep(names, qpos[:, model.jnt_qposadr[order]], qpos, len(ids))


def _swept_alone(model: MjModel, arm_joints: Sequence[str], joint: int) -> HandSweep:
    """Return the sweep of the only joint of a hand, which needs no simulation."""
    low, high = model.jnt_range[joint]
    qpos = np.tile(model.qpos0, (_FINE_STATIONS, 1))
    arm = [model.joint(name).id for name in arm_joints]
    qpos[:, model.jnt_qposadr[arm]] = np.clip(0.0, *model.jnt_range[arm].T)
    qpos[:, model.jnt_qposadr[joint]] = np.linspace(low, high, _FINE_STATIONS)
    return HandSweep((model.joint(joint).name,), qpos[:, model.jnt_qposadr[[joint]]], qpos, 1)


def _loosened(model: MjModel, arm_joints: Sequence[str], driven: Sequence[int]) -> MjModel:
    """Return a copy whose arm is held and whose driven joints follow their springs."""
    copy = mujoco.MjModel.__copy__(model)
    flags = mujoco.mjtDisableBit
    off = flags.mjDSBL_CONTACT | flags.mjDSBL_GRAVITY | flags.mjDSBL_ACTUATION
    copy.opt.disableflags |= int(off)
    copy.opt.timestep = 0.002
    copy.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    copy.dof_frictionloss[:] = 0
    for name in arm_joints:
        dof = model.joint(name).dofadr[0]
        copy.dof_armature[dof], copy.dof_damping[dof] = 1e6, 1e6
    for joint in driven:
        dof, armature = model.jnt_dofadr[joint], _ARMATURE[int(model.jnt_type[joint])]
        copy.dof_armature[dof] = armature
        copy.jnt_stiffness[joint] = _FREQUENCY**2 * armature
        copy.dof_damping[dof] = 2 * _FREQUENCY * armature
    return copy


def _commanded(
    model: MjModel, driven: Sequence[int], ends: Float[np.ndarray, "d 2"]
) -> Float[np.ndarray, "d 2"]:
    """Return the limits of the driven joints within the commands of their position servos."""
    limited = ends.copy()
    for actuator in range(model.nu):
        joint = int(model.actuator_trnid[actuator, 0])
        is_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
        if (
            is_joint
            and joint in driven
            and model.actuator_ctrllimited[actuator]
            and is_servo(model, actuator)
        ):
            row = list(driven).index(joint)
            low, high = np.clip(model.actuator_ctrlrange[actuator], *ends[row])
            if high > low:
                limited[row] = low, high
    return limited


def _ordered_ends(model: MjModel, data: Any, driven: Sequence[int]) -> Float[np.ndarray, "d 2"]:
    """Return the limits of the driven joints, for two joints in the order in which both fingers close.

    A finger closes if it moves toward the other one.
    """
    ends = model.jnt_range[driven].copy()
    if len(driven) != 2:
        return ends
    travel = np.ptp(ends, axis=1)
    if travel.max() > _UNEQUAL * travel.min():
        ends = _commanded(model, driven, ends)
    bodies = model.jnt_bodyid[list(driven)]
    places = []
    for column in range(2):
        data.qpos[model.jnt_qposadr[list(driven)]] = ends[:, column]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        places.append(data.subtree_com[bodies].copy())
    middle = np.mean(places, axis=0)
    toward = np.array([middle[1] - middle[0], middle[0] - middle[1]])
    closes = ((places[1] - places[0]) * toward).sum(axis=1) > 0
    ends[closes] = ends[closes, ::-1]  # from closed to open
    return ends
