import numpy as np
import pytest
import trimesh

from perception.inference.uncertainty import surface_deviation
from perception.types import ObjectEstimate, TriangleMesh

RADIUS, SCALE, SLOPE = 0.03, 0.05, 6.0


def decoded():
    """A ball whose radius grows with the first number of its code, by a tenth of the cube's half side."""
    line = (np.arange(32) + 0.5) / 16 - 1
    x, y, z = np.meshgrid(line, line, line, indexing="ij")
    inside = SLOPE * (RADIUS / SCALE - np.sqrt(x**2 + y**2 + z**2))
    jacobian = np.zeros((32, 32, 32, 16), np.float32)
    jacobian[..., 0] = SLOPE * 0.1
    return (0.5 + inside).astype(np.float32), jacobian


@pytest.fixture
def ball():
    mesh = trimesh.creation.icosphere(3, RADIUS)
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    surface = TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return ObjectEstimate(0, "can", np.zeros(16), T, np.full(3, SCALE), surface)


def deviation(ball, place, variance):
    covariance = np.zeros((25, 25))
    covariance[place, place] = variance
    return surface_deviation(ball, covariance, *decoded())


def test_each_part_of_the_covariance_moves_the_surface_as_geometry_says(ball):
    normals = ball.mesh.vertices / RADIUS
    np.testing.assert_allclose(deviation(ball, 0, 1.0), 0.1 * SCALE, rtol=0.02)  # the code: a wider ball
    np.testing.assert_allclose(deviation(ball, 17, 0.01), 0, atol=1e-4)  # a ball turned is the same ball
    world_x = np.abs(normals @ ball.T_world_object[:3, :3].T[:, 0])
    np.testing.assert_allclose(deviation(ball, 19, 1e-6), 1e-3 * world_x, atol=2e-5)
    along_z = RADIUS * normals[:, 2] ** 2
    np.testing.assert_allclose(deviation(ball, 24, 1e-4), 1e-2 * along_z, atol=2e-5)


def test_parts_add_up_as_variances(ball):
    both = np.zeros((25, 25))
    both[0, 0], both[19, 19] = 1e-2, 1e-6
    whole = surface_deviation(ball, both, *decoded())
    parts = deviation(ball, 0, 1e-2) ** 2 + deviation(ball, 19, 1e-6) ** 2
    np.testing.assert_allclose(whole, np.sqrt(parts), rtol=1e-6)
