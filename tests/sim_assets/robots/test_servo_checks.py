"""Servos of a small arm, just strong, stiff and damped enough and just not."""

import re

import numpy as np
import pytest

from sim_assets.rendering.headless import mujoco
from sim_assets.robots.robot_file import RobotFileError, read_robot
from sim_assets.robots.servo_checks import MIN_DAMPING, MIN_FREQUENCY, can_follow
from tests.sim_assets.robots.conftest import JOINTS, SLIDING


@pytest.fixture
def inertia():
    """Inertias [kg m^2] about the joints of the small arm in its home posture."""
    model = mujoco.MjModel.from_xml_string(SLIDING)
    data = mujoco.MjData(model)
    for name, angle in zip(JOINTS, (0.0, -0.5, 2.0, 0.0)):
        data.joint(name).qpos[0] = angle
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    for row, unit in zip(full, np.eye(model.nv)):
        mujoco.mj_mulM(model, data, row, unit)
    return np.array([full.diagonal()[model.joint(name).dofadr[0]] for name in JOINTS])


def problems(write, kp, kv, torque):
    servos = "".join(
        f'<position joint="{name}" kp="{p}" kv="{v}" forcerange="{-t} {t}"/>'
        for name, p, v, t in zip(JOINTS, kp, kv, torque)
    )
    path = write(SLIDING.replace("</mujoco>", f"<actuator>{servos}</actuator></mujoco>"))
    try:
        read_robot(path)
    except RobotFileError as error:
        return re.findall(r"joint '(\w+)' (?:has|is) (\S+)", str(error))
    return []


def test_servos_at_the_limits(write, inertia) -> None:
    kp = (1.1 * MIN_FREQUENCY) ** 2 * inertia
    kv = 2 * 1.1 * MIN_DAMPING * np.sqrt(kp * inertia)
    torque = 1.1 * 4.0 * inertia  # acceleration limit 4 rad/s^2
    assert problems(write, kp, kv, torque) == []
    assert problems(write, 0.8 * kp, kv, torque) == [(name, "too") for name in JOINTS]
    assert problems(write, kp, 0.8 * kv, torque) == [(name, "not") for name in JOINTS]
    assert [name for name, _ in problems(write, kp, kv, 0.8 * torque)] == list(JOINTS)


def test_own_servos_follow_when_they_are_stiff_and_damped_enough():
    def follows(kp, kv, joints=JOINTS):
        servos = "".join(f'<position joint="{name}" kp="{kp}" kv="{kv}"/>' for name in joints)
        mjcf = SLIDING.replace("</mujoco>", f"<actuator>{servos}</actuator></mujoco>")
        return can_follow(mujoco.MjModel.from_xml_string(mjcf), JOINTS)

    assert follows(900, 30)
    assert not follows(900, 0.0) and not follows(1e-3, 1.0)
    assert follows(900, 0.0, JOINTS[:-1])  # a joint has none: servos are added to all
