"""The arm against its published figures."""

import numpy as np
import pytest

from sim_assets.rendering.headless import mujoco
from sim_assets.robots import panda
from sim_assets.robots.panda_arm import (
    ARM_JOINTS,
    CAMERA_IN_HAND,
    FINGER_JOINTS,
    LINKS,
    MAX_WIDTH,
    Q_READY,
    WRIST_FOVY,
    add_arm,
    arm_description,
)

# Modified (Craig) Denavit-Hartenberg: a [m], d [m], alpha [rad], joint by joint.
DH = [
    (0, 0.333, 0), (0, 0, -np.pi / 2), (0, 0.316, np.pi / 2), (0.0825, 0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2), (0, 0, np.pi / 2), (0.088, 0, np.pi / 2),
]  # fmt: skip


@pytest.fixture(scope="module")
def arm():
    model = mujoco.MjModel.from_xml_string(arm_description().mjcf)
    return model, mujoco.MjData(model)


def set_posture(arm, q):
    model, data = arm
    data.qpos[:7] = q
    mujoco.mj_forward(model, data)
    return data


def test_tcp_of_the_ready_pose_is_where_it_is_published(arm):
    data = set_posture(arm, Q_READY)
    np.testing.assert_allclose(data.site(arm_description().tcp_site).xpos, (0.3069, 0, 0.4869), atol=1e-4)


def test_hand_points_down_and_closes_sideways_at_the_ready_pose(arm):
    rotation = set_posture(arm, Q_READY).site("tcp").xmat.reshape(3, 3)
    np.testing.assert_allclose(rotation, np.diag([1, -1, -1]), atol=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_flange_follows_the_denavit_hartenberg_chain(arm, seed):
    low, high = np.array([link.q_range for link in LINKS]).T
    q = np.random.default_rng(seed).uniform(low, high)
    T = np.eye(4)
    for (a, d, alpha), angle in zip(DH, q, strict=True):
        ca, sa, c, s = np.cos(alpha), np.sin(alpha), np.cos(angle), np.sin(angle)
        T = T @ [[c, -s, 0, a], [s * ca, c * ca, -sa, -d * sa], [s * sa, c * sa, ca, d * ca], [0, 0, 0, 1]]
    flange = T @ [0, 0, 0.107, 1]
    data = set_posture(arm, q)
    np.testing.assert_allclose(data.body("hand").xpos, flange[:3], atol=1e-5)


def test_camera_looks_along_the_hand_with_opencv_axes(arm):
    data = set_posture(arm, Q_READY)
    hand = data.body("hand").xmat.reshape(3, 3)
    optical = data.site(arm_description().camera_site)
    np.testing.assert_allclose(hand.T @ (optical.xpos - data.body("hand").xpos), CAMERA_IN_HAND, atol=1e-6)
    axes = optical.xmat.reshape(3, 3)
    np.testing.assert_allclose(axes[:, 2], hand[:, 2], atol=1e-6)
    np.testing.assert_allclose(axes[:, 0], hand[:, 1], atol=1e-6)
    gl_axes = data.camera("wrist").xmat.reshape(3, 3)  # MuJoCo's camera: y up, looking along -z
    np.testing.assert_allclose(gl_axes @ np.diag([1, -1, -1]), axes, atol=1e-6)


def test_fingers_open_to_the_full_width(arm):
    model, data = arm
    data.qpos[7:9] = MAX_WIDTH / 2
    mujoco.mj_forward(model, data)
    pads = data.geom("left_pad").xpos - data.geom("right_pad").xpos
    assert np.linalg.norm(pads) - 2 * 0.005 == pytest.approx(MAX_WIDTH, abs=1e-6)
    data.qpos[7:9] = 0


def test_masses_and_limits_are_the_published_ones(arm):
    model, _ = arm
    description = arm_description()
    assert [model.joint(i).name for i in range(model.njnt)] == [*ARM_JOINTS, *FINGER_JOINTS]
    assert model.body_mass.sum() == pytest.approx(17.45, abs=0.02)
    np.testing.assert_allclose(model.jnt_range[3], (-3.0718, -0.0698), atol=1e-5)
    np.testing.assert_allclose(description.velocity_limit[0], 0.9 * 2.175)
    np.testing.assert_allclose(description.acceleration_limit[1], 0.65 * 7.5)
    np.testing.assert_allclose(description.jerk_limit[6], 0.1 * 10000)


def test_every_geom_of_the_plain_arm_is_a_collision_shape(arm):
    model, _ = arm
    assert set(model.geom_group) == {3}
    assert all(model.geom(i).name for i in range(model.ngeom))


def test_gripper_servo_moves_both_fingers_alike_with_the_published_force(arm):
    """The tendon halves the force on each finger: the actuator exerts twice the 70 N of a finger."""
    model, _ = arm
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_arm(spec)
    scene = spec.compile()
    servo = scene.actuator("gripper")
    np.testing.assert_allclose(servo.forcerange, (-140.0, 140.0))
    np.testing.assert_allclose(servo.ctrlrange, (-0.1, 0.04))
    assert servo.gainprm[0] == 2000.0 == -servo.biasprm[1] and servo.biasprm[2] == -40.0
    np.testing.assert_allclose(scene.wrap_prm[:2], 0.5)
    np.testing.assert_allclose(scene.eq_data[0, :5], (0, 1, 0, 0, 0))
    for name in FINGER_JOINTS:
        np.testing.assert_allclose(scene.joint(name).range, (0.0, 0.04))
        np.testing.assert_allclose(scene.joint(name).axis, (0, 1, 0))
    assert model.jnt_limited.all()


def test_wrist_camera_has_its_field_of_view(arm):
    assert arm[0].camera("wrist").fovy[0] == WRIST_FOVY == panda().fovy == 45.0


def test_servos_hold_the_arm_against_gravity_without_force(arm):
    """Gravity compensation, as in the arm's own controller: no acceleration at rest in any posture."""
    data = set_posture(arm, Q_READY + 0.1)
    np.testing.assert_allclose(data.qfrc_gravcomp[:7] - data.qfrc_bias[:7], 0, atol=1e-9)
