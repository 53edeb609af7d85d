"""Position servos for arms and hands whose models have none that would do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from manipulation.robot import FingerMotion
from sim_assets.rendering.headless import MjModel, MjSpec, mujoco

GRIPPER = "nodeslam_gripper"  # tendon and actuator that drive a hand
DEFAULT_FORCE = 40.0  # [N] of each finger
_SATURATION = 0.02  # [rad] of tracking error at which an added servo gives its full torque
_POSTURES = 32  # random postures in which the inertia is computed
_FASTEST = 150.0  # [rad/s], natural frequency up to which the simulation is accurate
_JAW_SATURATION = 0.3  # share of a jaw's range at which its servo gives its full force
_SLOWEST_JAW = 8.0  # [rad/s], least natural frequency of a jaw
_DAMPING_RATIO = 0.1  # [s] velocity gain over position gain, as tuned for the shipped arms


@dataclass(frozen=True)
class JointServo:
    """A position servo to add to a joint.

    Attributes:
        name, joint: names of the actuator and its joint.
        gain: position gain in [Nm/rad].
        torque: largest torque in [Nm].
    """

    name: str
    joint: str
    gain: float
    torque: float


@dataclass(frozen=True)
class GripperServo:
    """One servo for all driven joints of a hand, on a tendon of their weighted sum.

    Attributes:
        joints: names of the driven joints.
        weights: their weights in the tendon's length, which grows as the hand opens.
        gain, damping: position and velocity gain in force per tendon length, and per its rate.
        force: largest force of the tendon.
        coupling: offset and slope of the second joint's position over the first's, each relative to the
            model's reference; None if the model couples them itself.
        remove: names of the actuators that it replaces.
    """

    joints: tuple[str, ...]
    weights: tuple[float, ...]
    gain: float
    damping: float
    force: float
    coupling: tuple[float, float] | None
    remove: tuple[str, ...]


def joint_servos(model: MjModel, joints: Sequence[str], torques: np.ndarray | None) -> tuple[JointServo, ...]:
    """Return servos that suit the joints' inertia and torque limits.

    Args:
        model: the arm.
        joints: names of the joints.
        torques: largest torques in [Nm]; None for those of the model's actuators, or where it states none,
            twice what an acceleration of all joints by 4 rad/s^2 takes.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    needed = 8.0 * _coupled_inertia(model, joints)
    servos = []
    for index, name in enumerate(joints):
        dof = model.joint(name).dofadr[0]
        moment = joint_inertia(model, data, int(dof))
        given = None if torques is None else float(torques[index])
        torque = given or torque_limit(model, name) or max(10.0, float(needed[index]))
        gain = float(np.clip(torque / _SATURATION, 900.0 * moment, _FASTEST**2 * moment))
        servos.append(JointServo(f"nodeslam_{name}", name, gain, torque))
    return tuple(servos)


def joint_inertia(model: MjModel, data: Any, dof: int) -> float:
    """Return the inertia [kg m^2] about a joint in the present posture, all others held."""
    return float(_mass_row(model, data, dof)[dof])


def _mass_row(model: MjModel, data: Any, dof: int) -> np.ndarray:
    unit, row = np.zeros(model.nv), np.zeros(model.nv)
    unit[dof] = 1.0
    mujoco.mj_mulM(model, data, row, unit)
    return row


def _coupled_inertia(model: MjModel, joints: Sequence[str]) -> np.ndarray:
    """Return the row sums of the mass matrix's magnitudes [kg m^2], the largest over postures of the arm.

    Times an acceleration, this bounds the torque that any combination of the joints' accelerations takes.
    """
    ids = [model.joint(name).id for name in joints]
    dofs = model.jnt_dofadr[ids]
    low, high = np.clip(model.jnt_range[ids], -np.pi, np.pi).T
    data = mujoco.MjData(model)
    most = np.zeros(len(ids))
    for posture in np.random.default_rng(0).uniform(low, high, (_POSTURES, len(ids))):
        data.qpos[model.jnt_qposadr[ids]] = posture
        mujoco.mj_forward(model, data)
        sums = [np.abs(_mass_row(model, data, int(dof))[dofs]).sum() for dof in dofs]
        np.maximum(most, sums, out=most)
    return most


def torque_limit(model: MjModel, joint: str) -> float | None:
    """Return the largest torque [Nm] that the model states for a joint, by actuator or joint; else None."""
    index = model.joint(joint).id
    if model.jnt_actfrclimited[index]:
        return float(np.abs(model.jnt_actfrcrange[index]).max())
    for actuator in actuators_of(model, [index]):
        gear = abs(float(model.actuator_gear[actuator, 0]))
        if model.actuator_forcelimited[actuator]:
            return float(np.abs(model.actuator_forcerange[actuator]).max()) * gear
        if model.actuator_ctrllimited[actuator] and not is_servo(model, actuator):
            control = float(np.abs(model.actuator_ctrlrange[actuator]).max())
            return control * gear * float(model.actuator_gainprm[actuator, 0])
    return None


def actuators_of(model: MjModel, joints: Sequence[int]) -> list[int]:
    """Return the actuators that act on any of the joints, directly or through a tendon."""
    found = []
    for actuator in range(model.nu):
        target = int(model.actuator_trnid[actuator, 0])
        if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT:
            moved = [target]
        elif model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_TENDON:
            start = model.tendon_adr[target]
            moved = model.wrap_objid[start : start + model.tendon_num[target]].tolist()
        else:
            continue
        if set(moved) & set(joints):
            found.append(actuator)
    return found


def is_servo(model: MjModel, index: int) -> bool:
    """Return whether an actuator is a position servo: force = kp (command - position) - kv velocity."""
    gain, bias = model.actuator_gainprm[index, 0], model.actuator_biasprm[index]
    return bool(
        model.actuator_gaintype[index] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_AFFINE
        and gain > 0
        and np.isclose(bias[1], -gain)
        and bias[2] <= 0
        and model.actuator_gear[index, 0] == 1
    )


def gripper_servo(model: MjModel, fingers: FingerMotion, hand: Sequence[int], force: float) -> GripperServo:
    """Return a servo that presses each pad with ``force`` [N].

    By the principle of virtual work the tendon's force is the pads' force times the change of the opening
    with the tendon's length.
    """
    driven = fingers.joint_names[: fingers.n_driven]
    travel = fingers.positions[-1, : fingers.n_driven] - fingers.positions[0, : fingers.n_driven]
    weights = tuple(float(np.sign(t)) / len(driven) for t in travel)
    lengths = fingers.positions[:, : fingers.n_driven] @ np.array(weights)
    ratio = float(np.ptp(fingers.widths) / np.ptp(lengths))  # of opening to tendon length
    coupling = None
    if len(driven) == 2 and not _are_coupled(model, driven):
        first, second = (model.joint(name) for name in driven)
        slope = float(travel[1] / travel[0])
        offset = (
            fingers.positions[0, 1] - second.qpos0[0] - slope * (fingers.positions[0, 0] - first.qpos0[0])
        )
        coupling = (float(offset), slope)
    tendon_force = force * ratio
    gain = tendon_force / (0.8 * float(np.ptp(lengths)))
    damping = 0.02 * gain
    if len(hand) == 1:  # a jaw has the inertia of its motor's gear, and no linkage that damps it
        gain = tendon_force / (_JAW_SATURATION * float(np.ptp(lengths)))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        inertia = joint_inertia(model, data, int(model.jnt_dofadr[hand[0]])) / weights[0] ** 2
        gain = max(gain, _SLOWEST_JAW**2 * inertia)
        damping = 2 * float(np.sqrt(gain * inertia))
    return GripperServo(
        joints=driven,
        weights=weights,
        gain=gain,
        damping=damping,
        force=tendon_force,
        coupling=coupling,
        remove=tuple(model.actuator(index).name for index in actuators_of(model, hand)),
    )


def tendon_lengths(fingers: FingerMotion, servo: GripperServo) -> np.ndarray:
    """Return the servo's commands at the openings ``fingers.widths``."""
    return fingers.positions[:, : fingers.n_driven] @ np.array(servo.weights)


def _are_coupled(model: MjModel, joints: Sequence[str]) -> bool:
    ids = {model.joint(name).id for name in joints}
    return any(
        model.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT
        and {int(model.eq_obj1id[e]), int(model.eq_obj2id[e])} == ids
        for e in range(model.neq)
    )


def add_joint_servos(spec: MjSpec, servos: Sequence[JointServo]) -> None:
    """Replace the actuators of the servos' joints; a real controller compensates the joints' friction."""
    joints = {servo.joint for servo in servos}
    for actuator in list(spec.actuators):
        if actuator.target in joints:
            spec.delete(actuator)
    for servo in servos:
        spec.joint(servo.joint).frictionloss = 0
        actuator = spec.add_actuator(
            name=servo.name, target=servo.joint, trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcelimited=True, forcerange=(-servo.torque, servo.torque),
        )  # fmt: skip
        actuator.set_to_position(kp=servo.gain, kv=servo.gain * _DAMPING_RATIO)


def add_gripper_servo(spec: MjSpec, servo: GripperServo) -> None:
    """Replace the hand's actuators by one servo on a tendon of the driven joints."""
    for actuator in list(spec.actuators):
        if actuator.name in servo.remove:
            spec.delete(actuator)
    tendon = spec.add_tendon(name=GRIPPER)
    for joint, weight in zip(servo.joints, servo.weights, strict=True):
        tendon.wrap_joint(joint, weight)
        spec.joint(joint).frictionloss = 0
    if servo.coupling is not None:
        equality = spec.add_equality(
            type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=servo.joints[1], name2=servo.joints[0],
            solref=(0.005, 1), solimp=(0.95, 0.99, 0.001, 0.5, 2),
        )  # fmt: skip
        equality.data[:5] = (*servo.coupling, 0, 0, 0)
    actuator = spec.add_actuator(
        name=GRIPPER, target=GRIPPER, trntype=mujoco.mjtTrn.mjTRN_TENDON,
        forcelimited=True, forcerange=(-servo.force, servo.force),
    )  # fmt: skip
    actuator.set_to_position(kp=servo.gain, kv=servo.damping)
