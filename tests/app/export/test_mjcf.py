"""MJCF: pose, mass properties, collision filters and the support, as MuJoCo reads them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.drawing import CLASS_COLORS
from app.export.mjcf import mjcf, upright, write_mjcf, wxyz
from perception.types import SupportPlane
from sim_assets.rendering.headless import mujoco

NORMAL = np.array([0.0, np.sin(0.2), np.cos(0.2)])
PLANE = SupportPlane(NORMAL, 0.1)


@pytest.fixture
def model(box_body, tmp_path):
    return mujoco.MjModel.from_xml_path(str(write_mjcf(tmp_path, [box_body], PLANE)))


def test_body_has_pose_and_mass_properties_of_the_estimate(model, box_body):
    body = model.body("bottle_7")
    T = box_body.estimate.T_world_object
    np.testing.assert_allclose(body.pos, T[:3, 3], atol=1e-6)
    w, x, y, z = body.quat
    np.testing.assert_allclose(Rotation.from_quat((x, y, z, w)).as_matrix(), T[:3, :3], atol=1e-6)
    assert body.mass[0] == pytest.approx(0.3, rel=1e-6)
    np.testing.assert_allclose(body.ipos, box_body.center, atol=1e-6)
    principal = Rotation.from_quat(body.iquat, scalar_first=True).as_matrix()
    np.testing.assert_allclose(
        principal @ np.diag(body.inertia) @ principal.T, box_body.inertia, rtol=1e-4, atol=1e-8
    )
    assert model.jnt_type[body.jntadr[0]] == mujoco.mjtJoint.mjJNT_FREE


def test_pieces_collide_and_the_visual_mesh_does_not(model):
    visual = model.geom("bottle_7")
    assert not visual.contype and not visual.conaffinity and visual.group == 2
    np.testing.assert_allclose(
        model.mat("bottle").rgba, (*np.array(CLASS_COLORS["bottle"]) / 255, 1), atol=1e-3
    )
    for index in range(2):
        piece = model.geom(f"bottle_7_{index}")
        assert piece.contype and piece.conaffinity and piece.group == 3 and piece.condim == 4
        np.testing.assert_allclose(piece.friction, (0.6, 0.005, 0.0001))
        np.testing.assert_allclose(piece.solref, (0.006, 1))
    assert model.ngeom == 4  # the support too


def test_gravity_acts_against_the_normal_of_the_support(model):
    np.testing.assert_allclose(model.opt.gravity, -9.81 * NORMAL, rtol=1e-6)
    assert model.opt.timestep == 0.002 and model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC


@pytest.mark.parametrize(("offset", "above"), [(0.1, 0.1), (0.9, None)])
def test_support_is_the_plane_or_touches_the_lowest_vertex(box_body, offset, above, tmp_path):
    """A plane that an object is sunk into is lowered as far as the object's lowest vertex."""
    path = write_mjcf(tmp_path, [box_body], SupportPlane(NORMAL, offset))
    support = mujoco.MjModel.from_xml_path(str(path)).geom("support")
    np.testing.assert_allclose(
        Rotation.from_quat(support.quat, scalar_first=True).apply((0, 0, 1)), NORMAL, atol=1e-6
    )
    lowest = (box_body.estimate.mesh_world.vertices @ NORMAL).min()
    assert 0.1 < lowest < 0.9
    assert support.pos @ NORMAL == pytest.approx(above or lowest, abs=1e-5)


def test_scene_is_written_with_its_meshes(box_body, tmp_path):
    assert write_mjcf(tmp_path, [box_body], PLANE) == tmp_path / "scene.xml"
    assert (tmp_path / "meshes" / "bottle_7.obj").is_file()
    assert (tmp_path / "scene.xml").read_text() == mjcf([box_body], PLANE)


def test_upright_frame_and_quaternion_order():
    np.testing.assert_allclose(upright(NORMAL)[:, 2], NORMAL, atol=1e-12)
    np.testing.assert_allclose(upright(np.array([0.0, 0.0, 1.0])), np.eye(3), atol=1e-12)
    quarter = Rotation.from_euler("z", np.pi / 2).as_matrix()
    np.testing.assert_allclose(wxyz(quarter), (np.sqrt(0.5), 0, 0, np.sqrt(0.5)), atol=1e-12)
