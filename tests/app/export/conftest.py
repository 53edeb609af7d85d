"""A rigid body with closed-form mass properties at a general pose."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from app.export.model import RigidModel
from perception.types import ObjectEstimate, TriangleMesh

SIDES = np.array([0.04, 0.06, 0.10])  # of the box [m]
CENTER = np.array([0.01, 0.02, 0.05])  # of the box in the object frame [m]
MASS = 0.3  # [kg]
ROTATION = Rotation.from_euler("ZYX", (0.9, 0.4, -0.3))
POSITION = np.array([0.5, -0.2, 0.3])


@pytest.fixture
def box_body() -> RigidModel:
    """A homogeneous box in two collision pieces, tilted about all axes, as bottle number 7."""
    mesh = trimesh.creation.box(SIDES)
    mesh.apply_translation(CENTER)
    vertices = np.asarray(mesh.vertices)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = ROTATION.as_matrix(), POSITION
    estimate = ObjectEstimate(
        7, "bottle", np.zeros(16), T, np.full(3, 0.06), TriangleMesh(vertices, np.asarray(mesh.faces))
    )
    half = np.where(vertices[:, 2:] > CENTER[2], CENTER, vertices)
    lower = np.column_stack([vertices[:, :2], half[:, 2]])
    upper = lower + np.array([0.0, 0.0, SIDES[2] / 2])
    a, b, c = SIDES**2
    inertia = MASS / 12 * np.diag([b + c, a + c, a + b]) + 1e-5 * np.array([[0, 1, 2], [1, 0, 3], [2, 3, 0]])
    return RigidModel(estimate, mesh, (lower, upper), MASS, CENTER, inertia)
