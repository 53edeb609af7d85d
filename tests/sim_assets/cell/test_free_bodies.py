"""Free bodies: inertia in closed form, collision geoms at their poses."""

from dataclasses import replace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from sim_assets.cell.free_bodies import add_object, set_friction
from sim_assets.cell.layout import PlanarPose
from sim_assets.objects import sample_object
from sim_assets.objects.convex.pieces import IDENTITY, CollisionPiece, hull
from sim_assets.rendering.headless import mujoco
from sim_assets.rendering.materials import Finish, solid


def test_inertia_of_a_plain_cylinder():
    """m (3 r^2 + h^2) / 12 across and m r^2 / 2 along the axis."""
    rng = np.random.default_rng(0)
    can = sample_object("can", "test", rng)
    radius, height, mass = 0.03, 0.1, can.mass
    mesh = trimesh.creation.cylinder(radius, height, sections=256)
    mesh.apply_translation((0, 0, height / 2))
    object.__setattr__(can, "mesh", mesh)
    spec = mujoco.MjSpec()
    add_object(spec, "cylinder", can, PlanarPose(0, 0, 0), Finish(solid((0.5, 0.5, 0.5))))
    inertia = np.sort(spec.compile().body("cylinder").inertia)
    expected = [mass * radius**2 / 2] + [mass * (3 * radius**2 + height**2) / 12] * 2
    np.testing.assert_allclose(inertia, np.sort(expected), rtol=2e-3)


def test_inertia_tensor_keeps_its_axes():
    """A mesh without symmetry: MuJoCo's tensor, rotated back, is m/V times the mesh's second moments."""
    can = sample_object("can", "test", np.random.default_rng(0))
    corners = np.array([(0, 0, 0), (0.08, 0.01, 0), (0.01, 0.05, 0.01), (0.02, 0.03, 0.12)])
    mesh = trimesh.convex.convex_hull(corners)
    spec = mujoco.MjSpec()
    add_object(spec, "wedge", replace(can, mesh=mesh), PlanarPose(0, 0, 0), Finish(solid((0.5, 0.5, 0.5))))
    body = spec.compile().body("wedge")
    axes = Rotation.from_quat(body.iquat, scalar_first=True).as_matrix()
    expected = mesh.moment_inertia * can.mass / mesh.volume
    np.testing.assert_allclose(axes @ np.diag(body.inertia) @ axes.T, expected, rtol=1e-5, atol=1e-10)
    np.testing.assert_allclose(body.ipos, mesh.center_mass, atol=1e-9)


def test_every_collision_piece_becomes_a_geom_at_its_pose():
    turn = np.array([np.cos(0.3), 0.0, np.sin(0.3), 0.0])
    pieces = (
        CollisionPiece("box", np.array([0.01, 0.02, 0.03]), turn, (0.01, 0.02, 0.03)),
        CollisionPiece("cylinder", np.array([0.0, 0.0, 0.05]), IDENTITY, (0.02, 0.05)),
        CollisionPiece("capsule", np.array([0.04, 0.0, 0.05]), turn, (0.005, 0.01)),
        hull(np.array([(0, 0, 0), (0.05, 0, 0), (0, 0.04, 0), (0, 0, 0.03)])),
    )
    can = replace(sample_object("can", "test", np.random.default_rng(0)), collision=pieces)
    spec = mujoco.MjSpec()
    add_object(spec, "can", can, PlanarPose(0.3, -0.2, 0.7), Finish(solid((0.5, 0.5, 0.5))))
    model = spec.compile()
    assert model.ngeom == len(pieces) + 1
    kinds = [model.geom(f"can_piece{i}").type[0] for i in range(4)]
    geom = mujoco.mjtGeom
    assert kinds == [geom.mjGEOM_BOX, geom.mjGEOM_CYLINDER, geom.mjGEOM_CAPSULE, geom.mjGEOM_MESH]
    for index, piece in enumerate(pieces[:3]):
        there = model.geom(f"can_piece{index}")
        np.testing.assert_allclose(there.pos, piece.position)
        np.testing.assert_allclose(there.quat, piece.quat_wxyz)
        np.testing.assert_allclose(there.size[: len(piece.size)], piece.size)
    body = model.body("can")
    np.testing.assert_allclose(body.pos, (0.3, -0.2, 0.0005))
    np.testing.assert_allclose(body.quat, (np.cos(0.35), 0, 0, np.sin(0.35)))
    assert model.jnt_type[body.jntadr[0]] == mujoco.mjtJoint.mjJNT_FREE


def test_friction_is_drawn_for_each_body_and_is_least_elsewhere():
    spec, rng = mujoco.MjSpec(), np.random.default_rng(0)
    finish = Finish(solid((0.5, 0.5, 0.5)))
    for index in range(2):
        mug = sample_object("mug", "test", rng)
        add_object(spec, f"object{index}", mug, PlanarPose(0.3 * index, 0, 0), finish)
    spec.worldbody.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1, 1, 0.1))
    set_friction(spec, (0.3, 0.9), rng)
    drawn = [{geom.friction[0] for geom in spec.body(f"object{i}").geoms} for i in range(2)]
    assert all(len(values) == 1 and 0.3 < min(values) < 0.9 for values in drawn) and drawn[0] != drawn[1]
    assert spec.geom("table").friction[0] == 0.3
