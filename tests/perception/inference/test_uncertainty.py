"""Predicted deviations of a surface, in closed form for a ball."""

import numpy as np
import pytest
import trimesh

from perception.inference.uncertainty import CalibrationConfig, calibrated_deviation, surface_deviation
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


def test_calibration_inflates_what_is_not_measured_and_keeps_a_floor(ball):
    """hypot(sqrt(1 - determined) inflation deviation, floor), for the class of the object."""
    covariance = np.zeros((25, 25))
    covariance[0, 0] = 1.0
    n = len(ball.mesh.vertices)
    determined = np.resize([0.0, 0.75, 1.0], n)
    config = CalibrationConfig({"can": 0.5, "mug": 9.0}, {"can": 1e-3, "mug": 9.0})
    found = calibrated_deviation(ball, covariance, determined, *decoded(), config)
    fitted = surface_deviation(ball, covariance, *decoded())
    np.testing.assert_allclose(fitted, 0.1 * SCALE, rtol=0.02)
    factor = np.resize([0.5, 0.25, 0.0], n)
    np.testing.assert_allclose(found, np.sqrt((factor * fitted) ** 2 + 1e-6), rtol=1e-6)


def test_default_calibration_is_the_measured_one():
    config = CalibrationConfig()
    assert config.inflation == {"mug": 0.395, "bowl": 0.45, "bottle": 0.62, "can": 0.47}
    assert config.floor == {"mug": 5.6e-4, "bowl": 6.6e-4, "bottle": 3.0e-4, "can": 3.85e-4}


def test_faint_walls_have_bounded_deviations(ball):
    grid, jacobian = decoded()
    covariance = np.zeros((25, 25))
    covariance[0, 0] = 1.0
    flat = surface_deviation(ball, covariance, np.full_like(grid, 0.5), jacobian)
    np.testing.assert_allclose(flat, SLOPE * 0.1 / (0.1 / (2 * SCALE / 32)), rtol=1e-5)
