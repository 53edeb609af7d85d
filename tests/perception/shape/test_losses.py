"""Training loss: weights of thin structures and handles, cross entropy and divergence by hand."""

import math

import numpy as np
import pytest
import torch

from perception.shape.losses import LossConfig, handle_region, shape_loss, thin_structures, voxel_weights
from perception.types import CATEGORIES

AXIS = np.arange(32) - 15.5
X, Y, Z = np.meshgrid(AXIS, AXIS, AXIS, indexing="ij")
MUG, CAN = CATEGORIES.index("mug"), CATEGORIES.index("can")


def cylinder(radius: float, x: float = 0.0) -> np.ndarray:
    return (np.hypot(X - x, Y) < radius) & (abs(Z) < 13)


def mug(radius: float) -> np.ndarray:
    """A body standing left of the middle with a bar, three voxels thick, as its handle."""
    body = cylinder(radius, x=-4) & ~(cylinder(radius - 2, x=-4) & (Z > -11))
    return body | ((-4 + radius < X) & (X < 13) & (abs(Y) < 2) & (abs(Z) < 2))


def test_only_the_handle_of_a_mug_is_its_handle():
    grid = (mug(8) * 255).astype(np.uint8)
    as_mug, as_can = handle_region(np.array([grid, grid]), np.array([MUG, CAN]))
    handle = as_mug & (grid > 0)
    assert not as_can.any()
    assert handle.any()
    assert X[handle].min() > 4  # the body ends at x = -4 + 8
    assert handle.sum() == np.count_nonzero((grid > 0) & (X > 4))


def test_thin_structures_are_walls_not_blocks():
    wall = np.zeros((1, 32, 32, 32), np.uint8)
    wall[0, 10:12, 4:28, 4:28] = 200
    block = np.zeros_like(wall)
    block[0, 8:14, 4:28, 4:28] = 255
    assert np.array_equal(thin_structures(wall), wall)
    assert not thin_structures(block).any()


def test_weights_are_one_in_the_open_and_add_up_at_a_handle():
    grids = (mug(8)[None] * 255).astype(np.uint8)
    config = LossConfig(thin=1.0, handle=3.0)
    weights = voxel_weights(grids, np.array([MUG]), config)
    assert weights.min() == 1.0
    assert weights.max() == pytest.approx(5.0)
    assert np.unique(voxel_weights(grids, np.array([MUG]), LossConfig(thin=0, handle=0))) == [1.0]


def test_loss_of_a_certain_and_right_answer_is_the_divergence():
    grids = torch.zeros(2, 4, 4, 4)
    grids[:, 1] = 1
    mean, log_variance = torch.ones(2, 16), torch.zeros(2, 16)
    loss, divergence = shape_loss(200 * grids - 100, grids, torch.ones_like(grids), mean, log_variance, 0.5)
    assert divergence.item() == pytest.approx(8.0)  # 16 entries of 1/2 mean^2
    assert loss.item() == pytest.approx(4.0)


def test_loss_by_hand():
    """Two grids of one voxel: w ln 2 each, and the divergence of N(1, 4) from N(0, 1)."""
    logits, grids = torch.zeros(2, 1, 1, 1), torch.tensor([0.0, 1.0]).reshape(2, 1, 1, 1)
    weights = torch.tensor([2.0, 5.0]).reshape(2, 1, 1, 1)
    mean, log_variance = torch.ones(2, 1), torch.full((2, 1), math.log(4.0))
    loss, divergence = shape_loss(logits, grids, weights, mean, log_variance, 0.5)
    expected = 0.5 * (1 + 4 - 1 - math.log(4))
    assert divergence.item() == pytest.approx(expected)
    assert loss.item() == pytest.approx(3.5 * math.log(2) + 0.5 * expected)


def test_default_weights_are_those_of_the_shipped_network():
    assert LossConfig() == LossConfig(beta=0.5, thin=1.0, handle=6.0)


def test_the_surroundings_of_thin_structures_weigh_as_much():
    wall = np.zeros((1, 32, 32, 32), np.uint8)
    wall[0, 10:12] = 255
    weights = voxel_weights(wall, np.array([CAN]), LossConfig(thin=2.0, handle=9.0))
    np.testing.assert_array_equal(np.flatnonzero(weights[0, :, 16, 16] == 3.0), [9, 10, 11, 12])
    assert set(np.unique(weights)) == {1.0, 3.0}
