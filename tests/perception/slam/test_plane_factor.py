"""Residuals of plane points: heights, derivative, robust weights."""

import numpy as np
import pytest

from perception.geometry import invert, se3_exp, transform_points
from perception.slam.plane_factor import PlaneNoise, evaluate_plane
from perception.types import SupportPlane

NOISE = PlaneNoise(sigma=0.005, huber=3.0, data_weight=0.1)
NORMAL = np.array([0.6, 0.0, 0.8])
PLANE = SupportPlane(NORMAL, 0.2)


def test_residuals_are_heights_above_the_plane(T_view):
    heights = np.array([-0.01, 0.0, 0.02])
    across = np.array([[0.1, 0.3, -0.075], [0, 1, 0], [-0.8, 0.2, 0.6]])
    world = across + (0.2 + heights)[:, None] * NORMAL
    points = transform_points(invert(T_view), world)
    rows = evaluate_plane(T_view, points, PLANE, NOISE)
    np.testing.assert_allclose(rows.residuals, heights, atol=1e-12)


def test_jacobian_agrees_with_finite_differences(T_view):
    points, eps = np.random.default_rng(0).normal(size=(6, 3)), 1e-6

    def heights(xi):
        return evaluate_plane(T_view @ se3_exp(xi), points, PLANE, NOISE).residuals

    numeric = np.stack([(heights(d) - heights(-d)) / (2 * eps) for d in eps * np.eye(6)], axis=1)
    rows = evaluate_plane(T_view, points, PLANE, NOISE)
    np.testing.assert_allclose(rows.jacobian, numeric, atol=1e-8)


def test_weights_are_huber_weights_over_the_variance():
    points = np.array([[0, 0, 0.2], [0, 0, 0.215], [0, 0, 0.23]])
    plane = SupportPlane(np.array([0.0, 0.0, 1.0]), 0.2)
    weights = evaluate_plane(np.eye(4), points, plane, NOISE).weights
    assert weights == pytest.approx(0.1 / 0.005**2 * np.array([1.0, 1.0, 0.5]))
