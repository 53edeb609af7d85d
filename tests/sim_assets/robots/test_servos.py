"""Added servos: their gains, the force that arrives at the pads, what they replace."""

import numpy as np
import pytest

from manipulation.robot import FingerMotion
from sim_assets.rendering.headless import mujoco
from sim_assets.robots.finger_motion import hand_joints, sweep_hand
from sim_assets.robots.hand_shape import measure_hand
from sim_assets.robots.servos import (
    GRIPPER,
    actuators_of,
    add_gripper_servo,
    add_joint_servos,
    gripper_servo,
    is_servo,
    joint_inertia,
    joint_servos,
    tendon_lengths,
    torque_limit,
)
from tests.sim_assets.robots.conftest import JOINTS, SLIDING, linkage

MOTORS = """<actuator><motor joint="turn" gear="2" ctrlrange="-20 20"/>
<position joint="lift" kp="100" kv="5"/>
<motor joint="bend" forcerange="-7 7"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def motors():
    return mujoco.MjModel.from_xml_string(SLIDING.replace("</mujoco>", MOTORS))


def test_torque_limits_come_from_motors_and_force_ranges(motors):
    assert torque_limit(motors, "turn") == 40 and torque_limit(motors, "bend") == 7
    assert torque_limit(motors, "lift") is None and torque_limit(motors, "roll") is None


def test_position_servos_are_told_from_motors(motors):
    assert [is_servo(motors, actuator) for actuator in range(3)] == [False, True, False]
    assert actuators_of(motors, [motors.joint("lift").id]) == [1]


def test_joint_inertia_is_the_diagonal_of_the_mass_matrix():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint axis="0 0 1" armature=".5"/>'
        '<geom type="sphere" size=".1" mass="2" pos="1 0 0"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert joint_inertia(model, data, 0) == pytest.approx(0.5 + 2 * 1 + 0.4 * 2 * 0.01)


def test_servos_are_stiff_but_within_what_the_time_step_allows(motors):
    servos = joint_servos(motors, JOINTS, None)
    data = mujoco.MjData(motors)
    mujoco.mj_forward(motors, data)
    for servo in servos:
        frequency = np.sqrt(
            servo.gain / joint_inertia(motors, data, int(motors.joint(servo.joint).dofadr[0]))
        )
        assert 29 < frequency < 151  # [rad/s]
    assert [servo.torque for servo in servos[:3:2]] == [40, 7]
    assert joint_servos(motors, JOINTS, np.array([1.0, 2, 3, 4]))[3].torque == 4


def test_torques_that_no_model_states_suffice_for_all_joints_moving_at_once():
    """The elbow of a stretched arm feels the shoulder's acceleration as well as its own."""
    heavy = SLIDING.replace('<geom name="palm"', '<geom name="load" mass="8" size=".03"/><geom name="palm"')
    model = mujoco.MjModel.from_xml_string(heavy)
    data, dofs = mujoco.MjData(model), [int(model.joint(name).dofadr[0]) for name in JOINTS]
    torques = np.array([servo.torque for servo in joint_servos(model, JOINTS, None)])
    assert torques.max() > 20
    for angles in np.random.default_rng(5).uniform(-2, 2, (20, len(JOINTS))):
        for name, angle in zip(JOINTS, angles):
            data.joint(name).qpos[0] = np.clip(angle, *model.joint(name).range)
        mujoco.mj_forward(model, data)
        acceleration, force = np.zeros(model.nv), np.zeros(model.nv)
        acceleration[dofs] = 4.0 * np.sign(angles)
        mujoco.mj_mulM(model, data, force, acceleration)
        assert (np.abs(force[dofs]) < 0.75 * torques).all()


def test_added_servos_replace_the_motors_of_their_joints_and_hold(motors):
    spec = mujoco.MjSpec.from_string(SLIDING.replace("</mujoco>", MOTORS))
    add_joint_servos(spec, joint_servos(motors, JOINTS, np.full(4, 50.0)))
    model = spec.compile()
    assert [model.actuator(a).name for a in range(model.nu)] == [f"nodeslam_{joint}" for joint in JOINTS]
    assert all(is_servo(model, a) for a in range(model.nu))


@pytest.mark.parametrize("mjcf", [SLIDING, linkage()], ids=["sliding", "linkage"])
def test_pads_press_with_the_stated_force(mjcf):
    """A held block feels the force, within what friction of the linkage and its varying leverage leave."""
    model = mujoco.MjModel.from_xml_string(mjcf)
    hand = measure_hand(model, JOINTS, sweep_hand(model, JOINTS, ("left", "right")))
    servo = gripper_servo(model, hand.fingers, hand_joints(model, JOINTS), 30.0)
    lengths = tendon_lengths(hand.fingers, servo)
    rates = np.gradient(hand.fingers.widths, lengths)
    forces = servo.force / rates  # of both pads on the block, by virtual work
    assert np.median(forces) == pytest.approx(30.0, rel=0.15)
    assert (np.diff(lengths) > 0).all()


def test_sliding_fingers_without_an_equality_are_coupled(sliding_model):
    hand = measure_hand(sliding_model, JOINTS, sweep_hand(sliding_model, JOINTS, ("left", "right")))
    servo = gripper_servo(sliding_model, hand.fingers, hand_joints(sliding_model, JOINTS), 30.0)
    assert servo.coupling == pytest.approx((0, -1), abs=1e-2)
    spec = mujoco.MjSpec.from_string(SLIDING)
    spec.option.gravity = (0, 0, 0)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # as in cells
    for geom in spec.geoms:
        geom.contype = 0
        geom.conaffinity = 0
    add_gripper_servo(spec, servo)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.ctrl[model.actuator(GRIPPER).id] = tendon_lengths(hand.fingers, servo)[-1]
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert data.joint("left").qpos[0] == pytest.approx(0.04, abs=1e-3)
    assert data.joint("right").qpos[0] == pytest.approx(-0.04, abs=1e-3)


def test_one_driven_joint_carries_the_whole_tendon(sliding_model):
    motion = FingerMotion(("left", "right"), np.array([0.0, 0.08]), np.array([[0, 0], [0.04, -0.04]]), 1)
    servo = gripper_servo(sliding_model, motion, [], 30.0)
    assert servo.weights == (1.0,) and servo.coupling is None
    assert servo.force == pytest.approx(60.0)  # the other finger is pulled along


def test_the_servo_of_a_jaw_is_critically_damped(jaw_model):
    model = mujoco.MjModel.__copy__(jaw_model)
    model.dof_armature[model.joint("jaw").dofadr[0]] = 0.1
    fingers = measure_hand(model, JOINTS, sweep_hand(model, JOINTS, ("jaw",))).fingers
    servo = gripper_servo(model, fingers, hand_joints(model, JOINTS), 30.0)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertia = joint_inertia(model, data, int(model.joint("jaw").dofadr[0]))
    assert servo.damping == pytest.approx(2 * np.sqrt(servo.gain * inertia)) and servo.coupling is None
    lever = np.ptp(fingers.widths) / np.ptp(fingers.positions)
    assert servo.force == pytest.approx(30 * lever)
