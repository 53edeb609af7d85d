"""The camera against closed form: projection, metric depth, ids, poses."""

import subprocess
import sys

import numpy as np
import pytest

from sim_assets.rendering.camera import OffscreenRenderer, camera_pose, intrinsics_of, look_at
from sim_assets.rendering.headless import mujoco

SCENE = """
<mujoco>
  <visual><map znear="0.01" zfar="20"/></visual>
  <statistic extent="1"/>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="floor" type="plane" size="3 3 .1"/>
    <geom name="ball" type="sphere" size=".02" pos=".1 .05 .3"/>
    <geom name="ghost" type="box" size="1 1 .01" pos="0 0 .5" group="3"/>
    <camera name="down" pos="0 0 .8" xyaxes="1 0 0 0 1 0" fovy="45"/>
    <camera name="slanted" pos="0 -.6 .6" xyaxes="1 0 0 0 1 1" fovy="50"/>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def scene():
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = OffscreenRenderer(model)
    yield model, data, renderer
    renderer.close()


def project(intrinsics, T_world_camera, point):
    local = T_world_camera[:3, :3].T @ (point - T_world_camera[:3, 3])
    return local[:2] / local[2] * (intrinsics.fx, intrinsics.fy) + (intrinsics.cx, intrinsics.cy), local[2]


def test_intrinsics_of_the_wrist_camera():
    intrinsics = intrinsics_of(640, 480, 45.0)
    assert intrinsics.fx == intrinsics.fy == pytest.approx(579.411, abs=1e-3)
    assert (intrinsics.cx, intrinsics.cy) == (319.5, 239.5)


@pytest.mark.parametrize(("camera", "fovy"), [("down", 45.0), ("slanted", 50.0)])
def test_ball_appears_where_it_projects_to(scene, camera, fovy):
    model, data, renderer = scene
    _, ids = renderer.depth_and_ids(data, camera, 320, 240)
    v, u = np.nonzero(ids == model.geom("ball").id)
    expected, _ = project(
        intrinsics_of(320, 240, fovy), camera_pose(data, camera), np.array([0.1, 0.05, 0.3])
    )
    np.testing.assert_allclose((u.mean(), v.mean()), expected, atol=0.35)


def test_depth_of_a_plane_seen_from_above_is_the_height(scene):
    _, data, renderer = scene
    depth, ids = renderer.depth_and_ids(data, "down", 160, 120)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth[ids == 0], 0.8, atol=2e-4)
    nearest = depth[ids == 1].min()
    assert nearest == pytest.approx(0.8 - 0.32, abs=1e-3)


def test_depth_of_a_slanted_plane_and_its_sky(scene):
    _, data, renderer = scene
    depth, ids = renderer.depth_and_ids(data, "slanted", 160, 120)
    intrinsics, T = intrinsics_of(160, 120, 50.0), camera_pose(data, "slanted")
    v, u = np.indices(depth.shape)
    rays = np.stack(
        [(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones(u.shape)]
    )
    down = np.tensordot(T[2, :3], rays, axes=1)
    floor = ids == 0
    np.testing.assert_allclose(depth[floor], (-T[2, 3] / down)[floor], rtol=1e-3)
    assert np.all(depth[ids < 0] == 0)


def test_collision_shapes_are_invisible(scene):
    model, data, renderer = scene
    _, ids = renderer.depth_and_ids(data, "down", 160, 120)
    assert model.geom("ghost").id not in ids


def test_images_of_several_sizes_are_copies(scene):
    _, data, renderer = scene
    small, large = renderer.color(data, "down", 80, 60), renderer.color(data, "down", 320, 240)
    again = renderer.color(data, "down", 80, 60)
    assert small.shape == (60, 80, 3) and large.shape == (240, 320, 3)
    assert np.array_equal(small, again)
    assert small.flags.owndata and small.std() > 0


def test_renders_again_after_close(scene):
    _, data, renderer = scene
    before = renderer.color(data, "down", 80, 60)
    renderer.close()
    assert np.array_equal(renderer.color(data, "down", 80, 60), before)


def test_look_at_puts_the_target_on_the_optical_axis():
    T = look_at(np.array([1.0, 0.5, 0.7]), np.array([0.1, 0.2, 0.0]))
    uv, depth = project(intrinsics_of(640, 480, 45.0), T, np.array([0.1, 0.2, 0.0]))
    np.testing.assert_allclose(uv, (319.5, 239.5), atol=1e-9)
    assert depth == pytest.approx(np.linalg.norm([0.9, 0.3, 0.7]))
    assert T[2, 1] < 0, "the image's down is not up in the world"
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


def test_a_renderer_left_open_ends_quietly():
    program = """
from sim_assets.rendering.headless import mujoco
from sim_assets.rendering.camera import OffscreenRenderer
model = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><camera name="eye" pos="0 0 1"/><geom size=".1"/></worldbody></mujoco>')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
kept = OffscreenRenderer(model)
kept.color(data, "eye", 32, 24)
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0
    assert ended.stderr == ""


@pytest.mark.parametrize("roll", [0.3, -1.2])
def test_roll_turns_the_image_about_the_optical_axis(roll):
    position, target = np.array([1.0, 0.5, 0.7]), np.array([0.1, 0.2, 0.0])
    relative = look_at(position, target)[:3, :3].T @ look_at(position, target, roll)[:3, :3]
    c, s = np.cos(roll), np.sin(roll)
    np.testing.assert_allclose(relative, [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=1e-12)


def test_nothing_beyond_ten_metres_is_measured():
    text = SCENE.replace('size="3 3 .1"', 'size="30 30 .1" pos="0 0 -9"').replace('zfar="20"', 'zfar="40"')
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = OffscreenRenderer(model)
    depth, ids = renderer.depth_and_ids(data, "slanted", 80, 60)
    renderer.close()
    assert (ids == 0).any() and depth.max() < 10.0
    assert (depth[(ids == 0)] == 0).any() and (depth[ids == 0] > 9.0).any()


def test_shadows_are_optional_and_segmentation_leaves_colour_alone(scene):
    _, data, renderer = scene
    before = renderer.color(data, "down", 160, 120)
    renderer.depth_and_ids(data, "down", 160, 120)
    np.testing.assert_array_equal(renderer.color(data, "down", 160, 120), before)
    assert (renderer.color(data, "down", 160, 120, shadows=False).astype(int) - before).max() > 20
