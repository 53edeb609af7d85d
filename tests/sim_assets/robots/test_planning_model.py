"""The planning model has the kinematics and collision geoms of the arm's own model."""

import numpy as np
import pytest

from sim_assets.rendering.headless import mujoco
from sim_assets.robots.mounting import Frame, Mount, compiled
from sim_assets.robots.planning_model import planning_mjcf

MJCF = """
<mujoco>
  <compiler angle="degree"/>
  <default><default class="solid"><geom group="3" type="capsule" rgba="1 0 0 1"/></default></default>
  <asset><mesh name="cube" scale=".1 .1 .3"
    vertex="-1 -1 -1  1 -1 -1  -1 1 -1  -1 -1 1  1 1 -1  1 -1 1  -1 1 1  1 1 1"/></asset>
  <worldbody>
    <geom name="post" group="3" type="box" size=".05 .05 .1"/>
    <frame pos="0 0 .2" euler="0 0 30">
      <body name="a/link"><joint name="a/turn" axis="0 0 1" range="-90 90"/>
        <geom name="fitted" class="solid" mesh="cube" pos=".1 0 0"/>
        <geom name="hull" group="3" type="mesh" mesh="cube" pos="0 .2 0" euler="0 20 0"/>
        <geom name="shell" type="sphere" size=".02" contype="0" conaffinity="0"/>
        <body name="tip" pos=".3 0 0"><joint name="bend" axis="0 1 0" range="-40 40"/>
          <site name="eye" euler="10 0 0"/>
          <geom name="light" size=".01" mass="0" group="3"/></body></body>
    </frame>
  </worldbody>
</mujoco>
"""
BASE = Frame(np.array([0.5, 0.1, 0.2]), np.array([np.cos(0.3), 0, 0, np.sin(0.3)]))


@pytest.fixture
def models(tmp_path):
    (tmp_path / "arm.xml").write_text(MJCF.replace('mass="0"', 'mass=".1"'))
    mount = Mount(tmp_path / "arm.xml", BASE, ("a/turn", "bend"))
    own = compiled(mount)
    return own, mujoco.MjModel.from_xml_string(planning_mjcf(own, BASE))


def poses(model, prefix, names, q):
    data = mujoco.MjData(model)
    for name, value in zip(("a/turn", "bend"), q, strict=True):
        data.joint(prefix + name).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    return [
        (data.geom(prefix + n).xpos.copy(), data.geom(prefix + n).xmat.reshape(3, 3).copy()) for n in names
    ]


def test_solid_geoms_are_where_they_were_moved_by_the_base(models):
    own, plan = models
    c, s = np.cos(0.6), np.sin(0.6)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    names, q = ("post", "fitted", "hull", "light"), (0.4, -0.3)
    for (x, A), (y, B) in zip(poses(own, "", names, q), poses(plan, "robot_", names, q), strict=True):
        np.testing.assert_allclose(y, R @ x + BASE.position, atol=1e-6)
        np.testing.assert_allclose(np.abs(np.einsum("ij,ij->j", B, R @ A)), 1, atol=1e-6)


def test_fitted_shapes_are_primitives_of_the_compiled_size(models):
    own, plan = models
    assert plan.geom("robot_fitted").type[0] == mujoco.mjtGeom.mjGEOM_CAPSULE
    np.testing.assert_allclose(plan.geom("robot_fitted").size, own.geom("fitted").size)
    assert plan.nmesh == 1 and plan.ngeom == 4 and (plan.geom_group == 3).all()


def test_joints_and_sites_keep_names_and_limits(models):
    own, plan = models
    np.testing.assert_allclose(plan.joint("robot_a/turn").range, own.joint("a/turn").range, atol=1e-5)
    np.testing.assert_allclose(plan.site("robot_eye").quat, own.site("eye").quat, atol=1e-5)
    assert plan.body("robot_a/link").id > 0
