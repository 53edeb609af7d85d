"""The references compute the same as what is timed beside them."""

import numpy as np
import pytest
import torch

from app.benchmarks import rows
from app.benchmarks.reference import gradient_step, plain_decoder, plain_jacobian_rows, plain_render
from app.benchmarks.scene import square_view
from perception.inference.observation import PixelSet
from perception.inference.problem import FitState, NoiseConfig
from perception.rendering.pose import ObjectPose, canonical_from_camera
from perception.rendering.renderer import RayBundle, ShapeGrid, render
from perception.shape.decoder import ShapeDecoder
from perception.shape.weights import load_weights


@pytest.fixture(scope="module")
def decoder():
    return ShapeDecoder.load()


def test_references_compute_the_same(decoder):
    """Ratios mean something only if both sides of a row do the same."""
    grid, jacobian = rows._mean_mug(decoder)
    code = torch.zeros(16)
    np.testing.assert_allclose(plain_decoder(load_weights(), "mug")(code[None])[0], grid, atol=1e-5)

    rays, A = square_view(side=9)
    image = render(rows._uploaded(grid, jacobian, "cpu"), rays, A)
    plain = plain_render(torch.from_numpy(grid), rays, torch.from_numpy(A).float())
    assert (image.mask > 0.2).sum() > 10  # the mug is in the picture
    np.testing.assert_allclose(image.depth, plain.depth, atol=2e-3)  # the kernel skips what hardly matters
    few = RayBundle(rays.directions[30:34], rays.view[30:34], rays.depth_range, rays.samples)
    by_autograd = plain_jacobian_rows(grid, jacobian, few, A)()
    assert by_autograd.shape == (4, 16 + 12)
    scale = np.abs(image.d_code).max()
    np.testing.assert_allclose(image.d_code[30:34], by_autograd[:, :16], atol=0.05 * scale)


def test_gradient_of_a_fits_cost(decoder):
    """The chain rule with the derivatives of the product's renderer; the prior alone without data."""
    few, _ = square_view(side=9)
    T = np.eye(4)
    T[:3, :3], T[2, 3] = np.diag([1.0, -1.0, -1.0]), 0.5
    n = len(few.directions)
    pose, code = ObjectPose(np.eye(3), np.zeros(3), np.full(3, 0.06)), np.linspace(-0.5, 0.5, 16)
    target, weight = np.full(n, 0.4, np.float32), np.linspace(0.5, 1.0, n).astype(np.float32)

    def gradient(weight: np.ndarray, code_prior: float) -> np.ndarray:
        pixels = PixelSet(few, T[None], target, np.ones(n, bool), weight, None)
        noise = NoiseConfig(code_prior=code_prior)
        return gradient_step(load_weights().decoder, "mug", pixels, FitState(pose, code), noise)()[0][
            0
        ].numpy()

    np.testing.assert_allclose(gradient(0 * weight, 0.4), 0.8 * code, rtol=1e-5)
    grid, jacobian = decoder.with_jacobian("mug", code)
    image = render(ShapeGrid.upload(grid, jacobian), few, canonical_from_camera(pose, T[None]))
    sigma2 = image.variance + NoiseConfig().depth_sigma ** 2
    expected = (2 * weight * (image.depth - target) / sigma2) @ image.d_code
    np.testing.assert_allclose(gradient(weight, 0.0), expected, atol=0.05 * np.abs(expected).max())
