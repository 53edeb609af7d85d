"""Reconstruction metrics on spheres, where distances are known."""

import numpy as np
import pytest
import trimesh

from perception.metrics import SurfaceSamples, point_recall, reconstruction_metrics, sample_surface
from perception.types import TriangleMesh


def sphere(radius: float, centre: tuple[float, float, float] = (0, 0, 0)) -> TriangleMesh:
    ball = trimesh.creation.icosphere(4, radius)
    return TriangleMesh(ball.vertices + centre, ball.faces)


def test_concentric_spheres_differ_by_their_radii() -> None:
    got = reconstruction_metrics(sphere(0.05), sphere(0.053), np.random.default_rng(0), n=8000)
    # Nearest samples lie a little aside: sqrt(3 mm^2 + about 1 mm^2).
    assert got.accuracy == pytest.approx(0.003, abs=3e-4)
    assert got.completeness == pytest.approx(0.003, abs=3e-4)
    assert got.chamfer_l1 == pytest.approx((got.accuracy + got.completeness) / 2)
    assert got.completion == 1.0


def test_half_a_surface_is_accurate_but_incomplete() -> None:
    truth = sphere(0.05)
    upper = truth.faces[(truth.vertices[truth.faces].mean(axis=1)[:, 2] > 0)]
    got = reconstruction_metrics(TriangleMesh(truth.vertices, upper), truth, np.random.default_rng(0), n=8000)
    assert got.accuracy < 0.0015
    # Within 1 cm of the upper half: z > about -1 cm; a sphere's area is uniform in z.
    assert got.completion == pytest.approx(0.6, abs=0.02)


def test_threshold_decides_completion() -> None:
    rng = np.random.default_rng(0)
    assert reconstruction_metrics(sphere(0.05), sphere(0.06), rng, n=4000, threshold=0.009).completion == 0.0
    assert reconstruction_metrics(sphere(0.05), sphere(0.06), rng, n=4000, threshold=0.013).completion == 1.0


def test_recall_of_given_points() -> None:
    points = np.array([[0.0, 0.0, 0.0535], [0.0, 0.0, 0.057]])  # the limit is 5 mm
    samples = SurfaceSamples.of(sphere(0.05), np.random.default_rng(0))
    assert point_recall(samples, points) == 0.5
    assert np.isnan(point_recall(samples, np.zeros((0, 3))))


def test_samples_lie_on_the_surface_and_repeat() -> None:
    a, b = (sample_surface(sphere(1.0), np.random.default_rng(3), 500) for _ in range(2))
    assert a.shape == (500, 3)
    np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(np.linalg.norm(a, axis=1), 1.0, atol=5e-3)


def test_distance_along_the_normal_is_free_of_the_spacing() -> None:
    sparse = SurfaceSamples.of(sphere(0.05), np.random.default_rng(0), 3000)
    points = sample_surface(sphere(0.052), np.random.default_rng(1), 500)
    along = sparse.distance_along_normal(points)
    assert np.median(np.abs(along - 0.002)) < 1e-4 < np.median(np.abs(sparse.distance(points) - 0.002))


def test_distances_up_to_a_limit_are_those_without_one() -> None:
    rng = np.random.default_rng(2)
    surface = SurfaceSamples.of(sphere(0.05), rng, 2000)
    points = rng.uniform(-0.2, 0.2, (5000, 3))
    exact = surface.distance(points)
    for limit in (0.0, 0.03, 0.1):
        expected = np.where(exact < limit, exact, np.inf)
        np.testing.assert_array_equal(surface.distance(points, limit), expected)
    assert 0 < (exact < 0.03).mean() < 0.5
