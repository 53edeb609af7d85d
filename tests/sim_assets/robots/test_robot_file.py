"""Users' own arms: meshes, defaults and degrees survive; what is wrong is said in one line."""

import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

import sim_assets.robots
from manipulation.collision import CollisionWorld, Contact
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE
from sim_assets.cell.scene import build_scene
from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import mujoco
from sim_assets.robots import load_robot
from tests.fuzzing import SHORT, damaged_bytes

SIXAXIS = Path(sim_assets.robots.__file__).parent / "sixaxis"

# Three axes, in degrees, with meshes from files, a default class, a keyframe, a light, settings, no sites.
MESHED = """
<mujoco>
  <compiler angle="degree" meshdir="parts"/>
  <option timestep="0.01" gravity="0 0 -1" integrator="Euler"/><size nuserdata="2"/>
  <visual><map znear="0.3"/></visual>
  <default><default class="solid"><geom group="3" type="mesh"/></default></default>
  <asset>
    <mesh name="link" file="link.stl" scale="0.001 0.001 0.001"/><mesh file="shell.stl"/>
    <texture name="paint" type="2d" builtin="flat" width="8" height="8"/>
    <material name="paint" texture="paint"/>
  </asset>
  <worldbody>
    <light pos="0 0 2"/>
    <body name="one" pos="0 0 0.2" euler="0 0 90">
      <joint name="turn" axis="0 0 1" range="-170 170"/>
      <geom class="solid" mesh="link" pos="0.1 0 0" material="paint"/>
      <geom type="mesh" mesh="shell" material="paint"/>
      <body name="two" pos="0.3 0 0">
        <joint name="bend" axis="0 1 0" range="-90 90"/>
        <geom class="solid" mesh="link"/>
        <body name="hand" pos="0.2 0 0">
          <joint name="roll" axis="1 0 0" range="-180 180"/>
          <geom group="3" type="box" size="0.02 0.08 0.02"/>
          <body name="left"><joint name="left" type="slide" axis="0 1 0" range="0 0.05"/>
            <geom group="3" type="box" size="0.03 0.005 0.01" pos="0.08 0.005 0"/></body>
          <body name="right"><joint name="right" type="slide" axis="0 -1 0" range="0 0.05"/>
            <geom group="3" type="box" size="0.03 0.005 0.01" pos="0.08 -0.005 0"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="left" joint2="right"/></equality>
  <actuator>
    <position name="a" joint="turn" kp="500" kv="50"/><position name="b" joint="bend" kp="500" kv="50"/>
    <position name="c" joint="roll" kp="100" kv="10"/>
    <general name="grip" joint="left" ctrlrange="0 255" gainprm="4" biastype="affine" biasprm="0 -20400 0"/>
  </actuator>
  <keyframe><key name="up" qpos="0 0 0 0 0"/></keyframe>
</mujoco>
"""
MESHED_FILE = """
mjcf = "arm.xml"
[arm]
joints = ["turn", "bend", "roll"]
actuators = ["a", "b", "c"]
home = [0.1, 0.5, 0.0]
velocity = [1, 1, 1]
acceleration = [5, 5, 5]
jerk = [100, 100, 100]
base = [0.05, 0.0, 0.1]
base_yaw = 0.5
[gripper]
joints = ["left", "right"]
actuator = "grip"
max_width = 0.1
open = 255
closed = 0
tcp = { body = "hand", position = [0.05, 0, 0], quaternion = [0.70710678, 0, 0.70710678, 0] }
[camera]
site = { body = "hand", position = [0, 0, 0.06], quaternion = [0.5, 0.5, 0.5, 0.5] }
fovy = 60
"""


@pytest.fixture
def meshed(tmp_path):
    (tmp_path / "parts").mkdir()
    wedge = trimesh.convex.convex_hull(
        np.array([(0, 0, 0), (200, 0, 0), (0, 40, 0), (0, 0, 30), (50, 50, 50)])
    )
    wedge.export(tmp_path / "parts" / "link.stl")
    trimesh.creation.icosphere(2, 0.06).export(tmp_path / "parts" / "shell.stl")
    (tmp_path / "arm.xml").write_text(MESHED)
    (tmp_path / "robot.toml").write_text(MESHED_FILE)
    return tmp_path / "robot.toml"


def test_an_arm_with_meshes_is_the_same_in_its_file_in_planning_and_in_scenes(meshed):
    robot = load_robot(str(meshed))
    alone = mujoco.MjModel.from_xml_path(str(meshed.with_name("arm.xml")))
    planned = mujoco.MjModel.from_xml_string(robot.description.mjcf)
    scene = build_scene([], [], None, np.random.default_rng(0), robot=robot).compile()
    q = np.array([0.4, -0.7, 1.1])
    c, s = np.cos(0.5), np.sin(0.5)
    expected = collision_vertices(alone, "", q) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    expected += (0.05, 0, 0.1)
    assert len(expected) == 10
    for model in (planned, scene):
        np.testing.assert_allclose(collision_vertices(model, "robot_", q), expected, atol=1e-6)
        np.testing.assert_allclose(model.joint("robot_bend").range, (-np.pi / 2, np.pi / 2), atol=1e-5)
    assert scene.opt.timestep == 0.002 and scene.opt.gravity[2] == -9.81 and scene.nkey == 0
    shown = [geom for geom in range(scene.ngeom) if scene.geom_bodyid[geom] == scene.body("robot_one").id]
    assert sorted(scene.geom_contype[shown]) == [0, 2]  # the shell is there and touches nothing
    assert robot.gripper_command(0.1) == 255 and robot.gripper_command(0.05) == pytest.approx(127.5, rel=1e-3)


def collision_vertices(model, prefix, q):
    """World positions of the corners of the links' meshes, in one order."""
    data = mujoco.MjData(model)
    for name, angle in zip(("turn", "bend", "roll"), q, strict=True):
        data.joint(prefix + name).qpos[:] = angle
    mujoco.mj_kinematics(model, data)
    found = []
    for body in ("one", "two"):
        for geom in range(model.ngeom):
            is_mesh = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH and model.geom_group[geom] == 3
            if is_mesh and model.geom_bodyid[geom] == model.body(prefix + body).id:
                mesh = model.geom_dataid[geom]
                start = model.mesh_vertadr[mesh]
                corners = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
                corners = corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
                found.append(corners[np.lexsort(corners.round(5).T)])
    return np.concatenate(found)


def test_sites_given_by_body_and_pose_and_gripper_in_planning(meshed):
    robot = load_robot(str(meshed))
    kinematics = Kinematics(robot.description)
    T = kinematics.forward(np.zeros(3))
    # The file's x is the world's y turned by base_yaw: 0.3 + 0.2 + 0.05 m along it, z of the tool too.
    ahead = np.array([-np.sin(0.5), np.cos(0.5), 0])
    np.testing.assert_allclose(T[:3, 3], np.array([0.05, 0, 0.3]) + 0.55 * ahead, atol=1e-6)
    np.testing.assert_allclose(T[:3, 2], ahead, atol=1e-6)
    world = CollisionWorld(robot.description, [], (TABLE,))
    assert world.contact(np.zeros(3), 0.1) is None
    assert world.contact(np.array([0, 1.5, 0]), 0.1) == Contact("arm", "table")


BAD = {
    "no such mjcf": (("toml", '"sixaxis.xml"', '"none.xml"'), "none.xml: no such MJCF file"),
    "no toml": (("toml", "[camera]", "[camera"), "cannot be read as TOML"),
    "missing key": (("toml", "home = ", "# home = "), r"\[arm\] home is missing"),
    "unknown key": (("toml", "fovy = ", "fov = 1\nfovy = "), "fov is unknown; known are fovy, site"),
    "wrong kind": (("toml", "max_width = 0.09", 'max_width = "9 cm"'), "max_width = '9 cm' must be a finite"),
    "width": (("toml", "max_width = 0.09", "max_width = 0"), "max_width = 0 must be above 0"),
    "number of limits": (("toml", "jerk = [350.0,", "jerk = ["), "jerk has 5 entries, expected 6"),
    "limit": (("toml", "velocity = [1.8,", "velocity = [-1.8,"), "a list of numbers of 0.02 to 50"),
    "slow": (("toml", "jerk = [350.0,", "jerk = [1e-9,"), "jerk = .* of 0.5 to 100000"),
    "fast": (("toml", "velocity = [1.8,", "velocity = [1e300,"), "of at most 1e\\+06 in magnitude"),
    "far": (("toml", "[arm]", "[arm]\nbase = [1e9, 0, 0]"), "base = .* of at most 10 in magnitude"),
    "long": (("toml", "fovy = ", f"fovy = {'1' * 400} # "), r"fovy = 1{77}\.\.\. must be a finite number"),
    "very long": (("toml", "fovy = ", f"fovy = {'1' * 5000} # "), "cannot be read as TOML"),
    "deep": (("toml", "[camera]", "a = " + "[" * 100_000), "cannot be read as TOML"),
    "many geoms": (("xml", "<worldbody>", "<worldbody>" + "<geom/>" * 3000), "more than 2000 geoms"),
    "joint": (("toml", 'joints = ["pan"', 'joints = ["pam"'), "no joint 'pam'; it has pan, lift"),
    "finger": (("toml", 'joints = ["left_finger"', 'joints = ["thumb"'), "no joint 'thumb'"),
    "actuator": (("toml", 'actuator = "gripper"', 'actuator = "grip"'), "no actuator 'grip'; it has pan"),
    "site": (("toml", 'tcp = "tcp"', 'tcp = "tip"'), "no site 'tip'; it has tcp, camera"),
    "body": (("toml", 'site = "camera"', 'site = { body = "x", position = [0, 0, 0] }'), "no body 'x'"),
    "home": (("toml", "home = [-0.4029", "home = [-4"), "home -4 of joint 'pan' is outside its range"),
    "order": (("toml", 'actuators = ["pan", "lift"', 'actuators = ["lift", "pan"'), "no position servo"),
    "too wide": (("toml", "max_width = 0.09", "max_width = 0.12"), "pads open to 0.0900 m: leave it out"),
    "command": (("toml", "open = 0.045", "open = 255"), "open = 255 is outside the actuator's ctrlrange"),
    "no xml": (("xml", "</worldbody>", ""), "sixaxis.xml cannot be read as MJCF"),
    "does not compile": (("xml", 'material="lens"', 'material="glass"'), "sixaxis.xml"),
    "motors": (("xml", 'kp="4000" kv="400"', 'kp="0"'), "'pan' is no position servo"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "message"), BAD.values(), ids=BAD)
def test_what_is_wrong_is_said(tmp_path, change, message):
    shutil.copytree(SIXAXIS, tmp_path / "arm")
    kind, old, new = change
    path = tmp_path / "arm" / ("robot.toml" if kind == "toml" else "sixaxis.xml")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1) if kind == "toml" else text.replace(old, new))
    with pytest.raises(RobotFileError, match=message):
        load_robot(str(tmp_path / "arm" / "robot.toml"))


def test_no_such_arm_lists_those_there_are():
    with pytest.raises(RobotFileError, match=re.escape("none of panda, sixaxis")):
        load_robot("pandda")


def test_the_example_explains_every_entry():
    text = (SIXAXIS / "robot.toml").read_text()
    assert set(tomllib.loads(text)) == {"mjcf", "arm", "gripper", "camera"}
    for entry in ("base", "base_yaw", "press", "tcp = { body"):
        assert entry in text


def test_a_device_is_no_robot_file():
    with pytest.raises(RobotFileError, match=r"--robot /dev/zero is a device, not a regular file: give"):
        load_robot("/dev/zero")


@SHORT
@given(data=st.data())
def test_random_damage_is_refused_with_one_line_or_read(tmp_path, data):
    """The MJCF does not exist, so that every file ends with an error: never another one."""
    path = tmp_path / "robot.toml"
    path.write_bytes(data.draw(damaged_bytes((SIXAXIS / "robot.toml").read_bytes())))
    with pytest.raises(RobotFileError):
        load_robot(str(path))
