"""Baseline renderers against closed forms and finite differences."""

import numpy as np
import pytest
import torch

from perception.geometry import rigid, so3_exp
from perception.rendering.comparison import BACKDROP, render_first_crossing, render_silhouette
from perception.rendering.pose import ObjectPose, canonical_from_camera, pose_jacobian
from perception.rendering.reference import render_reference
from perception.rendering.renderer import RayBundle, ShapeGrid

POSE = ObjectPose(so3_exp(np.array([0.1, -0.2, 0.5])), np.array([0.01, 0.0, 0.02]), np.full(3, 0.05))
CAMERA = rigid(so3_exp(np.array([np.pi, 0, 0])), np.array([0.0, 0.0, 0.5]))[None]  # looks down
RADIUS = 0.6  # of the ball, canonical
_LINE = np.linspace(-31 / 32, 31 / 32, 32)
_POINTS = np.stack(np.meshgrid(_LINE, _LINE, _LINE, indexing="ij"), axis=-1)


def ball(code: np.ndarray) -> np.ndarray:
    """Occupancy of a soft ball with centre 0.1 code[:3] and radius RADIUS + 0.1 code[3]."""
    distance = np.linalg.norm(_POINTS - 0.1 * code[:3], axis=-1) - (RADIUS + 0.1 * code[3])
    return (1 / (1 + np.exp(12 * distance))).astype(np.float32)


def upload(code: np.ndarray) -> ShapeGrid:
    steps = 1e-3 * np.eye(16)
    jacobian = np.stack([(ball(code + s) - ball(code - s)) / 2e-3 for s in steps], axis=-1)
    return ShapeGrid.upload(ball(code), jacobian.astype(np.float32))


@pytest.fixture(scope="module")
def rays() -> RayBundle:
    u, v = np.meshgrid(np.linspace(-0.09, 0.09, 15), np.linspace(-0.09, 0.09, 15))
    directions = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=-1)
    return RayBundle(directions, np.zeros(u.size, np.int64), np.array([[0.38, 0.6]]), samples=120)


def test_first_crossing_is_the_intersection_with_the_ball(rays) -> None:
    image = render_first_crossing(upload(np.zeros(16)), rays, canonical_from_camera(POSE, CAMERA))
    centre = CAMERA[0, :3, :3].T @ (POSE.translation - CAMERA[0, :3, 3])
    d, r = rays.directions, RADIUS * POSE.scale[0]
    a, b, c = (d * d).sum(1), d @ centre, centre @ centre - r * r
    root = b * b - a * c
    steep = root > 0.15 * b.max() ** 2 * (r / centre[2]) ** 2
    expected = (b - np.sqrt(np.maximum(root, 0))) / a
    assert steep.sum() > 40
    np.testing.assert_allclose(image.depth[steep], expected[steep], atol=2e-4)
    misses = image.mask == 0
    assert misses.any()
    np.testing.assert_allclose(image.depth[misses], rays.escape_depth[0], rtol=1e-6)
    assert image.d_code is not None and not image.d_code[misses].any()


def test_silhouette_agrees_with_the_reference_mask(rays) -> None:
    A = canonical_from_camera(POSE, CAMERA)
    image = render_silhouette(upload(np.zeros(16)), rays, A)
    expected = render_reference(
        torch.from_numpy(ball(np.zeros(16))).double(),
        torch.from_numpy(rays.directions),
        torch.from_numpy(rays.view),
        torch.from_numpy(A),
        torch.from_numpy(rays.depth_range),
        rays.samples,
    )
    np.testing.assert_allclose(image.mask, expected.mask.numpy(), atol=2e-4)
    np.testing.assert_allclose(image.depth, BACKDROP * (1 - image.mask), atol=1e-6)


@pytest.mark.parametrize("renderer", [render_first_crossing, render_silhouette])
def test_jacobian_agrees_with_finite_differences(renderer, rays) -> None:
    code = np.zeros(16)

    def depth(code: np.ndarray, pose: ObjectPose) -> np.ndarray:
        image = renderer(upload(code), rays, canonical_from_camera(pose, CAMERA))
        return image.depth.astype(np.float64)

    A = canonical_from_camera(POSE, CAMERA)
    image = renderer(upload(code), rays, A)
    analytic = np.concatenate([image.d_code, pose_jacobian(POSE, A, rays, image)], axis=1)
    clear = (image.mask > 0) & (image.depth < 0.46) if renderer is render_first_crossing else image.mask > -1
    for k in [*range(4), *range(16, 25)]:
        size = 3e-3 if k < 16 or k >= 22 else 3e-4 if k >= 19 else 3e-3
        step = np.zeros(25)
        step[k] = size
        ahead, behind = (depth(code + s * step[:16], POSE.moved(s * step[16:])) for s in (1, -1))
        numeric = (ahead - behind) / (2 * size)
        error = np.abs(analytic[:, k] - numeric)[clear]
        assert np.median(error) < 0.03 * max(np.abs(numeric[clear]).max(), 0.01), k
