"""Occupancy grids of watertight meshes."""

import numpy as np
import pytest
import trimesh

from perception.inference.voxelise import voxelise, voxels_of
from perception.types import TriangleMesh


def box(low, high) -> TriangleMesh:
    solid = trimesh.creation.box(bounds=[low, high])
    return TriangleMesh(np.asarray(solid.vertices), np.asarray(solid.faces))


def test_a_box_fills_its_voxels() -> None:
    """Voxels 4 to 11 along x, 8 to 23 along y, 16 to 19 along z, at 0.1 m for each canonical unit."""
    low, high = (np.array(index) / 16 * 0.1 - 0.1 for index in ((4, 8, 16), (12, 24, 20)))
    grid = voxelise(box(low, high), np.full(3, 0.1))
    expected = np.zeros((32, 32, 32), np.float32)
    expected[4:12, 8:24, 16:20] = 1
    np.testing.assert_array_equal(grid, expected)


def test_each_axis_has_its_own_scale() -> None:
    grid = voxelise(box([-0.05, -0.1, -0.2], [0.05, 0.1, 0.2]), np.array([0.1, 0.2, 0.4]))
    expected = np.zeros((32, 32, 32), np.float32)
    expected[8:24, 8:24, 8:24] = 1
    np.testing.assert_array_equal(grid, expected)


@pytest.mark.parametrize("supersample", [1, 2, 4])
def test_voxels_on_the_border_are_partly_occupied(supersample) -> None:
    half = np.array([0.5 + 1 / 32, 0.5, 0.5])  # half a voxel more to each side along x
    grid = voxelise(box(-half, half), np.ones(3), supersample)
    assert grid[16, 16, 16] == 1 and grid[6, 16, 16] == 0
    if supersample > 1:
        assert grid[7, 16, 16] == grid[24, 16, 16] == 0.5


def test_voxelise_leaves_cavities_empty() -> None:
    outer, inner = trimesh.creation.icosphere(3, 0.05), trimesh.creation.icosphere(3, 0.03)
    inner.invert()
    hollow = trimesh.util.concatenate([outer, inner])
    grid = voxelise(TriangleMesh(hollow.vertices, hollow.faces), np.full(3, 0.06))
    assert grid[16, 16, 16] == 0.0
    assert grid[16, 16, 5] == 1.0  # z = -0.039: in the shell


def test_the_scale_of_a_mesh_leaves_the_usual_margin() -> None:
    box = trimesh.creation.box((0.1, 0.06, 0.2))
    mesh = TriangleMesh(np.asarray(box.vertices), np.asarray(box.faces))
    grid, scale = voxels_of(mesh)
    np.testing.assert_allclose(0.9 * scale, (0.05, 0.03, 0.1))
    np.testing.assert_array_equal(grid, voxelise(mesh, scale))
    assert grid.sum() * (2 * scale / len(grid)).prod() == pytest.approx(0.1 * 0.06 * 0.2, rel=0.1)
