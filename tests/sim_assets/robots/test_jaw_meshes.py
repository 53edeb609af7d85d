"""Concave meshes of a jaw are collided piece by piece, convex ones as they are."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from sim_assets.rendering.headless import mujoco
from sim_assets.robots.jaw_meshes import SLAB, convex_parts, split_meshes


def bracket():
    """An L of two plates, 100 mm along x and 60 mm along y, 10 mm thick."""
    plates = trimesh.creation.box((0.1, 0.01, 0.02)), trimesh.creation.box((0.01, 0.06, 0.02))
    plates[1].apply_translation((-0.045, 0.025, 0))
    return trimesh.util.concatenate(plates)


def contains(part, point):
    hull = ConvexHull(part)
    return bool((hull.equations @ np.append(point, 1.0) < 1e-6).all())


def test_the_parts_leave_the_space_between_the_plates_free():
    mesh = bracket()
    parts = convex_parts(mesh.vertices, mesh.faces)
    assert len(parts) >= 0.1 / SLAB
    free, solid = np.array([0.02, 0.02, 0.0]), np.array([0.02, 0.0, 0.0])
    assert contains(mesh.vertices, free * [0, 1, 1])
    assert not any(contains(part, free) for part in parts) and any(contains(part, solid) for part in parts)


def test_a_convex_mesh_stays_as_it_is():
    box = trimesh.creation.icosphere(2, 0.03)
    assert convex_parts(box.vertices, box.faces) == ()


def test_geoms_of_a_body_are_replaced_at_their_pose():
    mesh = bracket()
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.add_mesh(name="l", uservert=mesh.vertices.ravel(), userface=mesh.faces.ravel())
    body = spec.worldbody.add_body(name="jaw", pos=(0, 0, 1))
    geom = body.add_geom(name="l", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="l", pos=(0.1, 0, 0), contype=1)
    geom.quat = (np.sqrt(0.5), 0, 0, np.sqrt(0.5))
    split_meshes(spec, body)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    solid = np.flatnonzero(model.geom_contype)
    assert len(solid) > 5 and model.geom("l").id not in solid
    ends = data.geom_xpos[solid]  # x of the mesh is y of the body
    assert ends[:, 1].min() == pytest.approx(-0.05, abs=0.006) and ends[:, 1].max() == pytest.approx(
        0.05, abs=0.006
    )
    assert np.median(ends[:, 0]) == pytest.approx(0.1, abs=1e-3) and ends[:, 2] == pytest.approx(
        1.0, abs=1e-3
    )
