"""Whether the servos of an arm can follow motions within its limits.

About a joint of inertia I, a position servo of gains kp and kv is an oscillator of natural frequency
sqrt(kp / I) and damping ratio (kv + d) / (2 sqrt(kp I)), d being the joint's own damping. Gravity is
compensated.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.servos import joint_inertia
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
        frequency = np.sqrt(gain / inertia)
        damping = (model.dof_damping[dof] - model.actuator_biasprm[index, 2]) / (2 * np.sqrt(gain * inertia))
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


def _torque(model: MjModel, index: int) -> float:
    """Return the largest torque [Nm] of a joint's servo; infinite without a limit."""
    limited = model.actuator_forcelimited[index]
    return float(np.abs(model.actuator_forcerange[index]).max()) if limited else np.inf
