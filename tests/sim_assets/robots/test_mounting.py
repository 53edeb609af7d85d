"""Mounting of an MJCF arm: frames, camera axes, collision filters, hands in files of their own."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import mujoco
from sim_assets.robots.mounting import Frame, HandFile, Mount, SitePose, add_to_scene, compiled, load

MJCF = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.01" gravity="0 0 -1"/>
  <visual><map znear="0.5"/></visual>
  <asset>
    <mesh name="wedge" file="wedge.stl" scale="0.001 0.001 0.001"/><mesh name="shell" file="wedge.stl"/>
    <material name="paint" rgba="1 0 0 1"/>
  </asset>
  <worldbody>
    <light pos="0 0 2"/>
    <body name="link" pos="0 0 0.2">
      <joint name="turn" axis="0 0 1" range="-3 3"/>
      <geom name="solid" group="3" type="mesh" mesh="wedge" pos="0.1 0 0" material="paint"/>
      <geom name="shown" type="mesh" mesh="shell"/>
      <body name="finger" pos="0.3 0 0">
        <joint name="slide" type="slide" axis="0 1 0" range="0 0.04"/>
        <geom name="stem" group="3" type="box" size="0.01 0.01 0.02" mass="0.1"/>
        <body name="tip" pos="0 0 0.02"><geom name="pad" group="3" type="box" size="0.01 0.01 0.01"/></body>
      </body>
    </body>
  </worldbody>
  <keyframe><key name="home" qpos="0 0"/></keyframe>
</mujoco>
"""
BASE = Frame(np.array([0.5, 0.1, 0.2]), Rotation.from_euler("z", 0.4).as_quat(scalar_first=True))
OPTICAL = Frame(
    np.array([0.01, 0.02, 0.03]), Rotation.from_euler("xyz", (0.3, -0.5, 1.1)).as_quat(scalar_first=True)
)


@pytest.fixture
def mount(tmp_path):
    corners = np.array([(0, 0, 0), (60, 0, 0), (0, 40, 0), (0, 0, 30), (50, 50, 50)], dtype=float)
    trimesh.convex.convex_hull(corners).export(tmp_path / "wedge.stl")
    (tmp_path / "arm.xml").write_text(MJCF)
    return Mount(
        tmp_path / "arm.xml", BASE, ("turn",), sites=(SitePose("eye", "link", OPTICAL),), camera_site="eye"
    )


@pytest.fixture
def scene(mount):
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    spec.option.gravity = (0, 0, -9.81)
    add_to_scene(mount, spec, 52.0)
    return spec.compile()


def at(model, angle, opening=0.0):
    data = mujoco.MjData(model)
    data.joint("robot_turn").qpos[:], data.joint("robot_slide").qpos[:] = angle, opening
    mujoco.mj_forward(model, data)
    return data


def test_base_frame_places_the_arm(scene):
    data = at(scene, 0.3, 0.02)
    base = Rotation.from_euler("z", 0.4)
    in_base = Rotation.from_euler("z", 0.3).apply((0.3, 0.02, 0)) + np.array([0, 0, 0.2])
    expected = BASE.position + base.apply(in_base)
    np.testing.assert_allclose(data.body("robot_finger").xpos, expected, atol=1e-9)


@pytest.mark.parametrize(("lean", "touching"), [(0.0, 0), (0.3, 1)], ids=["vertical", "leaning"])
def test_a_link_that_turns_about_the_vertical_may_graze_the_table(mount, lean, touching):
    """Its friction would hold the arm's first joint; a link that turns otherwise collides."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=(2, 2, 0.1), pos=(0, 0, 0.22), contype=1, conaffinity=2
    )
    quaternion = Rotation.from_euler("x", lean).as_quat(scalar_first=True)
    add_to_scene(replace(mount, base=Frame(np.array([0.0, 0, 0.1]), quaternion)), spec, 52.0)
    model = spec.compile()
    data = at(model, 0.0)
    link = model.body("robot_link").id
    bodies = [set(model.geom_bodyid[contact.geom].tolist()) for contact in data.contact]
    assert ({0, link} in bodies) == bool(touching)
    assert {0, model.body("robot_finger").id} in bodies


def test_camera_has_the_optical_frame_in_opengl_axes_and_its_field_of_view(scene):
    data = at(scene, -0.7)
    site, camera = data.site("robot_eye"), data.camera("wrist")
    link = data.body("robot_link")
    optical = link.xmat.reshape(3, 3) @ Rotation.from_quat(OPTICAL.quaternion, scalar_first=True).as_matrix()
    np.testing.assert_allclose(site.xmat.reshape(3, 3), optical, atol=1e-9)
    np.testing.assert_allclose(site.xpos, link.xpos + link.xmat.reshape(3, 3) @ OPTICAL.position, atol=1e-9)
    np.testing.assert_allclose(camera.xmat.reshape(3, 3), optical @ np.diag([1, -1, -1]), atol=1e-9)
    np.testing.assert_allclose(camera.xpos, site.xpos, atol=1e-9)
    assert scene.camera("wrist").fovy[0] == 52.0


def test_options_of_the_scene_win_and_gravity_is_compensated_on_the_arm(scene):
    assert scene.opt.timestep == 0.002 and scene.opt.gravity[2] == -9.81
    assert scene.vis.map.znear < 0.1 and scene.nkey == 0 and scene.nlight == 0
    np.testing.assert_array_equal(scene.body_gravcomp, [0, 1, 1, 1])
    np.testing.assert_allclose(at(scene, 0.3).qacc, 0, atol=1e-9)


def test_collision_geoms_are_those_of_group_3(scene):
    def bits(name):
        geom = scene.geom("robot_" + name)
        return int(geom.contype[0]), int(geom.conaffinity[0])

    assert bits("shown") == (0, 0)
    assert bits("solid") == bits("stem") == bits("pad") == (2, 1)


@pytest.mark.parametrize(("limits", "expected"), [("-3 3", 3.0), ("-170 170", np.deg2rad(170))])
def test_ranges_that_are_radians_are_read_as_such(mount, limits, expected):
    """In fragments of larger models, whose compiler element says so."""
    text = MJCF.replace('<compiler angle="radian"/>', "").replace(
        'range="-3 3"', f'range="{limits}" limited="true"'
    )
    mount.mjcf.write_text(text)
    assert compiled(mount).joint("turn").range[1] == pytest.approx(expected)


def test_scenery_is_left_out_and_unnamed_parts_get_names(mount):
    floor = '<geom type="plane" size="1 1 .1"/><body><geom size=".1" contype="0" conaffinity="0"/></body>'
    mount.mjcf.write_text(MJCF.replace("<worldbody>", "<worldbody>" + floor))
    model = compiled(mount, visuals=True)
    assert all(model.body(b).name for b in range(model.nbody)) and not (model.geom_type == 0).any()


def test_one_arm_of_several_is_kept(mount):
    other = '<body name="other"><joint name="o" type="slide"/><geom size=".1"/></body>'
    camera = '<camera name="watch" mode="targetbody" target="other"/><camera name="fixed"/>'
    mount.mjcf.write_text(MJCF.replace("<worldbody>", "<worldbody>" + camera + other))
    model = compiled(replace(mount, root="link"))
    assert (model.njnt, [model.camera(c).name for c in range(model.ncam)]) == (2, ["fixed"])
    with pytest.raises(RobotFileError, match=r"no body 'left' \(\[arm\] body\); it has other, link"):
        load(replace(mount, root="left"))


def test_a_hand_from_its_own_file_is_mounted_at_a_site(mount, tmp_path):
    """The hand's file is in degrees, the arm's in radians; both keep their own."""
    (tmp_path / "hand.xml").write_text(
        '<mujoco><worldbody><body name="palm" euler="90 0 0"><geom size=".01"/>'
        '<joint name="curl" range="-90 90"/></body></worldbody></mujoco>'
    )
    arm = MJCF.replace("</body>", '<site name="flange" pos="0 0 .01" euler="0 0 .5"/></body>', 1)
    mount.mjcf.write_text(arm)
    hand = HandFile(tmp_path / "hand.xml", "flange", Frame(np.array([0.0, 0, 0.1]), np.array([1.0, 0, 0, 0])))
    model = compiled(replace(mount, hand=hand))
    data = at_zero(model)
    flange = data.site("flange")
    expected = flange.xpos + 0.1 * flange.xmat.reshape(3, 3)[:, 2]
    np.testing.assert_allclose(data.body("hand_palm").xpos, expected, atol=1e-9)
    np.testing.assert_allclose(model.joint("hand_curl").range, [-np.pi / 2, np.pi / 2], atol=1e-9)
    with pytest.raises(
        RobotFileError, match=r"no site or body 'wrist' \(\[hand\] mount\); its sites are flange"
    ):
        load(replace(mount, hand=replace(hand, mount="wrist")))


def at_zero(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="link"', 'name="arm"', "has no body 'link', on which the file places a site"),
        ("</worldbody>", "", "cannot be read as MJCF"),
    ],
)
def test_faults_name_file_and_part(mount, old, new, message):
    mount.mjcf.write_text(MJCF.replace(old, new))
    with pytest.raises(RobotFileError, match=rf"arm\.xml {message}"):
        load(mount)


def test_missing_file(mount):
    mount.mjcf.unlink()
    with pytest.raises(RobotFileError, match=r"arm\.xml: no such MJCF file"):
        load(mount)


def test_an_arm_is_cut_out_of_a_larger_robot(mount):
    """The cart's drive and the head go, with their actuators; the arm stays where it was."""
    cart = """<body name="cart" pos="1 0 0"><joint name="drive" type="slide"/><geom name="hull" size=".2"/>
      <body name="head"><joint name="nod"/><geom size=".1"/></body><body name="link" pos="0 0 0.2">"""
    motors = '</body></worldbody><actuator><motor joint="drive"/><motor joint="nod"/></actuator>'
    text = MJCF.replace('<body name="link" pos="0 0 0.2">', cart).replace("</worldbody>", motors)
    mount.mjcf.write_text(text.replace("</mujoco>", "<sensor><jointpos joint='drive'/></sensor></mujoco>"))
    mount.mjcf.write_text(mount.mjcf.read_text().replace(' qpos="0 0"', ""))
    model = compiled(replace(mount, root="link"))
    assert [model.joint(j).name for j in range(model.njnt)] == ["turn", "slide"]
    assert model.nu == model.nsensor == 0 and "hull" not in {model.geom(g).name for g in range(model.ngeom)}
    np.testing.assert_allclose(model.body("cart").pos, [1, 0, 0])


def test_joints_of_the_arm_that_turn_without_end_get_a_range(mount):
    for before, after in ((' range="-3 3"', ""), (' range="-3 3"', ' limited="false" range="-3 3"')):
        mount.mjcf.write_text(MJCF.replace(before, after))
        np.testing.assert_allclose(compiled(mount).joint("turn").range, [-2 * np.pi, 2 * np.pi])


def test_all_missing_files_are_named(mount):
    texture = '<texture name="t" type="2d" file="paint.png"/><mesh name="shell" file="shell.stl"/>'
    mount.mjcf.write_text(MJCF.replace('<mesh name="shell" file="wedge.stl"/>', texture))
    with pytest.raises(RobotFileError) as error:
        compiled(mount)
    assert len(error.value.problems) == 2 and "paint.png is missing" in str(error.value)
