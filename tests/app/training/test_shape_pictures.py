"""Figures of the shape prior's card: shaded shapes, tiles, and the derivative of one rendered depth."""

import cv2
import numpy as np
import pytest
import torch

from app.training import shape_pictures
from app.training.shape_pictures import CODE, PIXEL, RECONSTRUCTIONS, STEPS, TILE, WALK
from perception.rendering.reference import render_reference
from perception.shape.dataset import ShapeDataset
from perception.shape.network import ShapeVae
from perception.types import CATEGORIES

AXIS = np.arange(32) - 15.5
X, Y, Z = np.meshgrid(AXIS, AXIS, AXIS, indexing="ij")
CAN = CATEGORIES.index("can")


def cylinder(radius):
    """Occupancies of an upright solid cylinder, radius in voxels."""
    return ((np.hypot(X, Y) < radius) & (abs(Z) < 13)).astype(np.float32)


@pytest.fixture(scope="module")
def data():
    return ShapeDataset.from_grids({"can": np.stack([cylinder(r) for r in (5, 7, 9, 11)])})


def test_a_shape_is_drawn_in_the_middle_of_a_white_tile():
    tile = shape_pictures.portrait(cylinder(9), CAN)
    drawn = (tile < 250).any(axis=-1)
    assert tile.shape == (TILE, TILE, 3) and not drawn[:, 0].any() and not drawn[0].any()
    assert np.argwhere(drawn).mean(axis=0) == pytest.approx([TILE / 2] * 2, abs=6)


def test_a_grid_without_surface_is_a_white_tile():
    assert (shape_pictures.portrait(np.zeros((32, 32, 32), np.float32), CAN) == 255).all()


def test_wider_shapes_cover_more_of_the_tile():
    covered = [(shape_pictures.portrait(cylinder(r), CAN) < 250).any(axis=-1).sum() for r in (5, 9, 12)]
    assert covered[0] < covered[1] < covered[2]


def test_the_derivative_is_that_of_the_depth_with_respect_to_each_occupancy():
    grid = torch.from_numpy(0.02 + 0.6 * cylinder(8))
    rays, A = shape_pictures._camera(shape_pictures._SIDE_VIEW, 9)
    pixel = 4 * 9 + 4
    derivative = shape_pictures._by_occupancies(grid.numpy(), rays, A, pixel)

    def depth(values):
        directions = torch.from_numpy(rays.directions[pixel : pixel + 1])
        camera, depth_range = torch.from_numpy(A).float(), torch.from_numpy(rays.depth_range).float()
        views = torch.zeros(1, dtype=torch.int64)
        return float(render_reference(values, directions, views, camera, depth_range, rays.samples).depth)

    where = np.unravel_index(np.abs(derivative).argmax(), derivative.shape)
    step = torch.zeros_like(grid)
    step[where] = 0.02
    numeric = (depth(grid + step) - depth(grid - step)) / 0.04
    assert derivative[where] == pytest.approx(numeric, rel=0.05)
    assert derivative[where] < 0  # a higher occupancy in front reduces the depth


def test_all_figures_are_written_with_a_tile_for_each_shape_and_step(data, tmp_path):
    model = ShapeVae().eval()
    paths = shape_pictures.draw_shape_pictures(model, data, tmp_path)
    assert [path.name for path in paths] == [RECONSTRUCTIONS, WALK, PIXEL, CODE]
    sizes = {path.name: cv2.imread(str(path)).shape for path in paths}
    assert sizes[RECONSTRUCTIONS] == (2 * TILE, shape_pictures.SHOWN * TILE, 3)
    assert sizes[WALK] == (TILE, STEPS * TILE, 3)
