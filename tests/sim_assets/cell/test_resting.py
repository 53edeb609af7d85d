"""Resting poses by physics: what stands, what falls, what is reported."""

from contextlib import nullcontext

import numpy as np
import pytest
import trimesh

from sim_assets.cell.resting import body_poses, damped, is_still, settle, tilt
from sim_assets.cell.unknown import as_body
from sim_assets.rendering.headless import mujoco


def block(x, y, z):
    mesh = trimesh.creation.box((x, y, z))
    mesh.apply_translation((0, 0, z / 2))
    return as_body(mesh)


def leaning(angle):
    T = np.eye(4)
    T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T[2, 3] = 0.05
    return T


def test_a_block_leaning_less_than_its_diagonal_falls_back_and_one_leaning_more_falls_over():
    """A block of 4 x 4 x 10 cm is balanced at arctan(4 / 10) = 21.8 degrees."""
    for degrees, rests_at in ((12, 0), (35, 90)):
        settled = settle([(block(0.04, 0.04, 0.10), leaning(np.deg2rad(degrees)))])
        assert settled.at_rest
        assert np.rad2deg(tilt(settled.poses[0])) == pytest.approx(rests_at, abs=1)


def test_a_block_set_down_on_another_stands_on_it():
    above = np.eye(4)
    above[2, 3] = 0.06
    settled = settle([(block(0.1, 0.1, 0.05), np.eye(4)), (block(0.06, 0.06, 0.05), above)])
    assert settled.at_rest
    assert settled.poses[1][2, 3] == pytest.approx(0.05, abs=1e-3)


def test_stillness_counts_speed_and_rotation_of_each_body():
    assert is_still(np.zeros(12))
    assert not is_still(np.eye(12)[0] * 0.01) and not is_still(np.eye(12)[9] * 0.1)


def test_poses_of_free_joints():
    T = body_poses(np.array([1.0, 2, 3, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]))[0]
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)


def test_damped_bodies_that_overlap_part_slowly():
    """Two blocks start 2 mm inside each other: pushed apart at once they fly, damped they barely move."""
    scene = """
    <mujoco><option gravity="0 0 0"/><worldbody>
      <body name="a" pos="0 0 0"><freejoint name="a"/><geom type="box" size=".02 .02 .02"/></body>
      <body name="b" pos=".038 0 0"><freejoint name="b"/><geom type="box" size=".02 .02 .02"/></body>
    </worldbody></mujoco>"""

    def final_speed(is_damped):
        model = mujoco.MjModel.from_xml_string(scene)
        data = mujoco.MjData(model)
        with damped(model, ["a", "b"]) if is_damped else nullcontext():
            mujoco.mj_step(model, data, 250)
        assert not model.dof_damping.any()
        return abs(data.qvel).max()

    assert final_speed(False) > 0.01 and final_speed(True) < 0.001
