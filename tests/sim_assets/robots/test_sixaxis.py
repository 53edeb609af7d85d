"""The second arm: its published figures, its motion in a cell, and what planning knows of it."""

import numpy as np
import pytest

from manipulation.kinematics import Kinematics
from manipulation.robot import Robot
from manipulation.trajectories import JointLimits, MotionConfig, joint_move
from sim_assets.cell import ground_truth, viewer_meshes
from sim_assets.cell.config import CellConfig
from sim_assets.cell.layout import Region
from sim_assets.cell.scene import build_scene
from sim_assets.cell.world import World
from sim_assets.objects import sample_object
from sim_assets.rendering.headless import mujoco
from sim_assets.robots import SHIPPED, load_robot, panda
from sim_assets.robots.panda_arm import ARM_JOINTS, POSITION_GAINS, VELOCITY_GAINS

# Denavit-Hartenberg of the UR5e: a [m], d [m], alpha [rad], joint by joint; its zeros in ours.
DH = [
    (0, 0.1625, np.pi / 2), (-0.425, 0, 0), (-0.3922, 0, 0),
    (0, 0.1333, np.pi / 2), (0, 0.0997, -np.pi / 2), (0, 0.0996, 0),
]  # fmt: skip
ZEROS = np.array([np.pi, np.pi / 2, 0, np.pi / 2, 0, 0])


@pytest.fixture(scope="module")
def robot():
    return load_robot("sixaxis")


@pytest.fixture(scope="module")
def world(robot):
    can = sample_object("can", "train", np.random.default_rng(2))  # straight: its width is that of its body
    region = Region(x=(0.5, 0.5001), y=(-0.1, -0.0999))
    with World(CellConfig((can,), seed=0, region=region, robot=robot)) as world:
        yield world


def test_shipped_arms_go_by_their_names(robot):
    assert SHIPPED == ("panda", "sixaxis")
    assert load_robot("panda") is panda()
    assert robot.description.max_width == 0.09


@pytest.mark.parametrize("seed", range(3))
def test_flange_follows_the_denavit_hartenberg_chain(robot, seed):
    model = mujoco.MjModel.from_xml_string(robot.description.mjcf)
    data = mujoco.MjData(model)
    q = np.random.default_rng(seed).uniform(-2, 2, 6)
    data.qpos[:6] = q
    mujoco.mj_kinematics(model, data)
    T = np.eye(4)
    for (a, d, alpha), angle in zip(DH, q - ZEROS, strict=True):
        ca, sa, c, s = np.cos(alpha), np.sin(alpha), np.cos(angle), np.sin(angle)
        T = T @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    np.testing.assert_allclose(data.body("robot_hand").xpos, T[:3, 3], atol=1e-6)
    np.testing.assert_allclose(data.body("robot_hand").xmat.reshape(3, 3)[:, 2], T[:3, 2], atol=1e-6)


def test_gripper_commands(robot):
    assert [panda().gripper_command(x) for x in (0.0, 0.02, 0.08)] == pytest.approx([0.0, 0.01, 0.04])
    assert robot.gripper_command(0.09) == pytest.approx(0.045)
    assert robot.gripper_command(0.0) == 0


def test_it_holds_its_home_posture_and_moves_where_it_is_told(world):
    assert isinstance(world, Robot)
    arm = world.arm
    np.testing.assert_allclose(world.joint_positions(), arm.q_home, atol=1e-3)
    goal = arm.q_home + np.array([0.3, 0.1, -0.2, 0.2, 0.1, 0.4])
    world.follow(joint_move(world.joint_positions(), goal, JointLimits.of(arm, MotionConfig())))
    np.testing.assert_allclose(world.joint_positions(), goal, atol=1e-3)
    assert world.move_gripper(0.06) == pytest.approx(0.06, abs=5e-4)
    assert world.move_gripper(0.0) == pytest.approx(0.0, abs=5e-4)
    assert world.move_gripper(0.09) == pytest.approx(0.09, abs=5e-4)


def test_planning_and_simulation_agree_where_hand_and_camera_are(world):
    kinematics, q = Kinematics(world.arm), world.joint_positions()
    frame = world.capture()
    np.testing.assert_allclose(kinematics.forward(q, "camera"), frame.T_world_camera, atol=1e-9)
    names = viewer_meshes.moving_bodies(world)
    tcp = viewer_meshes.poses(world)[names.index("tcp")]
    np.testing.assert_allclose(kinematics.forward(q)[:3, 3], tcp[:3], atol=1e-9)
    assert "robot_hand" in names and "robot_hand" in viewer_meshes.body_meshes(world)


def test_it_lifts_a_can(world):
    can, start = ground_truth.object_models(world)[0], ground_truth.object_poses(world)[0]
    kinematics, limits = Kinematics(world.arm), JointLimits.of(world.arm, MotionConfig())
    T = np.diag([1.0, -1.0, -1.0, 1.0])

    def move(height):
        T[:3, 3] = *start[:2, 3], can.height - 0.022 + height
        result = kinematics.inverse(T, [world.joint_positions(), *kinematics.seeds_toward(T)])
        assert result.converged
        world.follow(joint_move(world.joint_positions(), result.q, limits))

    move(0.12)
    move(0.0)
    assert world.move_gripper(0.0) == pytest.approx(2 * can.radius, abs=0.006)
    assert ground_truth.held(world, 0)
    move(0.15)
    assert ground_truth.touching(world, 0) == {"robot_left_finger", "robot_right_finger"}
    end = ground_truth.object_poses(world)[0]
    assert end[2, 3] - start[2, 3] == pytest.approx(0.15, abs=0.002) and end[2, 2] > np.cos(np.radians(2))


def test_scenes_have_the_pandas_servos_as_published():
    model = build_scene([], [], None, np.random.default_rng(0)).compile()
    actuators = [model.actuator(name).id for name in ARM_JOINTS]
    np.testing.assert_array_equal(model.actuator_gainprm[actuators, 0], POSITION_GAINS)
    np.testing.assert_array_equal(-model.actuator_biasprm[actuators, 2], VELOCITY_GAINS)
