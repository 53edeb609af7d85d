"""A grasp holds by friction alone: close on a can, lift it, swing it, and it has hardly moved in the hand."""

import numpy as np
import pytest

from manipulation.robot import JointTrajectory
from sim_assets.cell import ground_truth
from sim_assets.cell.config import CellConfig
from sim_assets.cell.layout import Region
from sim_assets.cell.world import World
from sim_assets.objects import sample_object
from sim_assets.rendering.headless import mujoco
from sim_assets.robots.panda_arm import arm_description


@pytest.fixture(scope="module")
def world():
    can = sample_object("can", "train", np.random.default_rng(2))  # straight: as wide anywhere
    region = Region(x=(0.5, 0.5001), y=(-0.1, -0.0999))
    with World(CellConfig((can,), seed=0, region=region)) as world:
        yield world


def reach(position, q):
    """Joint angles for the TCP at a position, hand pointing down: damped least squares on the plain arm."""
    model = mujoco.MjModel.from_xml_string(arm_description().mjcf)
    data = mujoco.MjData(model)
    jacobian = np.zeros((6, model.nv))
    down = np.diag([1.0, -1.0, -1.0])
    for _ in range(200):
        data.qpos[:7] = q
        mujoco.mj_forward(model, data)
        site = data.site("tcp")
        rotation = down @ site.xmat.reshape(3, 3).T
        skew = 0.5 * (rotation - rotation.T)
        turn = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        error = np.concatenate([position - site.xpos, turn])
        if np.abs(error).max() < 1e-4:
            return q
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("tcp").id)
        J = jacobian[:, :7]
        q = q + 0.5 * J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), error)
    raise AssertionError(f"no posture for {position}")


def move(world, position, duration=1.0):
    start = world.joint_positions()
    end = reach(np.asarray(position), start)
    s = np.arange(0, duration + 0.002, 0.004)[:, None] / duration
    world.follow(
        JointTrajectory(
            0.004,
            start + (end - start) * (10 * s**3 - 15 * s**4 + 6 * s**5),
            (end - start) * (30 * s**2 - 60 * s**3 + 30 * s**4) / duration,
            (end - start) * (60 * s - 180 * s**2 + 120 * s**3) / duration**2,
        )
    )


def tcp_to_object(world):
    site = world._data.site("tcp")
    return site.xmat.reshape(3, 3).T @ (ground_truth.object_poses(world)[0][:3, 3] - site.xpos)


def test_can_is_lifted_carried_and_set_down(world):
    can = ground_truth.object_models(world)[0]
    start = ground_truth.object_poses(world)[0]
    x, y = start[:2, 3]
    height = can.height - 0.022
    move(world, (x, y, height + 0.12))
    move(world, (x, y, height))
    assert not ground_truth.held(world, 0)
    width = world.move_gripper(0.0)
    assert width == pytest.approx(2 * can.radius, abs=0.006)
    assert ground_truth.held(world, 0)
    gripped = tcp_to_object(world)
    move(world, (x, y, height + 0.2))
    move(world, (x - 0.05, y + 0.3, height + 0.25))
    world.wait(0.5)
    assert ground_truth.touching(world, 0) == {"left_finger", "right_finger"}
    assert np.linalg.norm(tcp_to_object(world) - gripped) < 0.002
    move(world, (x, y, height + 0.2))
    move(world, (x, y, height + 0.001))
    world.move_gripper(min(width + 0.02, 0.08))
    move(world, (x, y, height + 0.15))
    end = ground_truth.object_poses(world)[0]
    assert np.linalg.norm(end[:3, 3] - start[:3, 3]) < 0.006
    assert end[2, 2] > np.cos(np.radians(1))
