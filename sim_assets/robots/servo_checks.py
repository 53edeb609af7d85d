"""Whether the servos of an arm can follow motions within its limits.

About a joint of inertia I, a position servo of gains kp and kv is an oscillator of natural frequency
sqrt(kp / I) and damping ratio (kv + d) / (2 sqrt(kp I)), d being the joint's own damping. Gravity is
compensated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.servos import actuators_of, is_servo, joint_inertia
from sim_assets.robots.simulated_arm import SimulatedArm

MIN_FREQUENCY = 5.0  # [rad/s]; slower servos lag behind by decimetres
MIN_DAMPING = 0.2  # ratio below which the hand swings for seconds after each motion
_REMEDY = "or leave out [arm] actuators and give torque, and servos are added"


def servo_problems(model: MjModel, robot: SimulatedArm) -> Iterator[str]:
    """Yield the servos that are too weak, too soft or not damped, at the home posture."""
    arm, data = robot.description, mujoco.MjData(model)
    for name, angle in zip(arm.joint_names, arm.q_home, strict=True):
        data.joint(name).qpos[0] = angle
    mujoco.mj_forward(model, data)
    joints = zip(arm.joint_names, robot.actuators, arm.acceleration_limit, strict=True)
    for joint, actuator, acceleration in joints:
        index, dof = model.actuator(actuator).id, int(model.joint(joint).dofadr[0])
        inertia, gain = joint_inertia(model, data, dof), float(model.actuator_gainprm[index, 0])
        needed, torque = inertia * acceleration, _torque(model, index)
        frequency, damping = _oscillator(model, index, dof, inertia)
        if needed > torque:
            yield (
                f"the servo of joint '{joint}' has {torque:.3g} Nm, but its acceleration limit of "
                f"{acceleration:g} rad/s² needs {needed:.3g} Nm: lower the limit, or raise the forcerange"
            )
        if frequency < MIN_FREQUENCY:
            stiff = MIN_FREQUENCY**2 * inertia
            yield (
                f"the servo of joint '{joint}' is too soft: raise its kp of {gain:.3g} above {stiff:.3g}, "
                f"{_REMEDY}"
            )
        elif damping < MIN_DAMPING:
            enough = 2 * np.sqrt(gain * inertia)
            yield f"the servo of joint '{joint}' is not damped: give it kv = {enough:.3g}, {_REMEDY}"


def can_follow(model: MjModel, joints: Sequence[str]) -> bool:
    """Return whether the model's own servos are stiff and damped enough, the joints being at their middle.

    True too for joints without exactly one servo each, whose servos are added in any case.
    """
    ids = [model.joint(name).id for name in joints]
    servos = [[index for index in actuators_of(model, [joint]) if is_servo(model, index)] for joint in ids]
    if not all(len(found) == 1 for found in servos):
        return True
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[ids]] = model.jnt_range[ids].mean(axis=1)
    mujoco.mj_forward(model, data)
    for joint, (servo,) in zip(ids, servos, strict=True):
        dof = int(model.jnt_dofadr[joint])
        frequency, damping = _oscillator(model, servo, dof, joint_inertia(model, data, dof))
        if frequency < MIN_FREQUENCY or damping < MIN_DAMPING:
            return False
    return True


def _oscillator(model: MjModel, index: int, dof: int, inertia: float) -> tuple[float, float]:
    """Return natural frequency [rad/s] and damping ratio of a servo about a joint of an inertia [kg m^2]."""
    gain = float(model.actuator_gainprm[index, 0])
    damping = float(model.dof_damping[dof] - model.actuator_biasprm[index, 2])
    return float(np.sqrt(gain / inertia)), damping / (2 * float(np.sqrt(gain * inertia)))


def _torque(model: MjModel, index: int) -> float:
    """Return the largest torque [Nm] of a joint's servo; infinite without a limit."""
    limited = model.actuator_forcelimited[index]
    return float(np.abs(model.actuator_forcerange[index]).max()) if limited else np.inf
