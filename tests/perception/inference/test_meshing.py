"""Meshes of grids: closed, outward, in place, and thin parts kept."""

import numpy as np
import pytest
import trimesh
from skimage.measure import marching_cubes

from perception.inference.meshing import (
    EmptyShapeError,
    MeshConfig,
    mesh_from_code,
    mesh_from_grid,
    sharpen,
)
from perception.inference.voxelise import voxelise
from perception.types import TriangleMesh

LINE = -1 + (2 * np.arange(32) + 1) / 32
X, Y, Z = np.meshgrid(LINE, LINE, LINE, indexing="ij")


def _trimesh(mesh: TriangleMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def _soft(distance: np.ndarray, slope: float = 16.0) -> np.ndarray:
    """Occupancy of a signed distance in canonical units: averaged over a voxel, as training grids are."""
    return np.clip(0.5 - slope * distance, 0, 1).astype(np.float32)


def test_ball_is_closed_round_and_outward() -> None:
    scale = np.array([0.05, 0.06, 0.07])
    mesh = mesh_from_grid(_soft(np.sqrt(X**2 + Y**2 + Z**2) - 0.7), scale, "can")
    solid = _trimesh(mesh)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(
        4 / 3 * np.pi * 0.7**3 * scale.prod(), rel=0.02
    )  # negative if inward
    radii = np.linalg.norm(mesh.vertices / scale, axis=1)
    np.testing.assert_allclose(radii, 0.7, atol=0.01)


def test_object_that_touches_the_grid_border_is_closed() -> None:
    solid = _trimesh(mesh_from_grid(np.ones((32, 32, 32), np.float32), np.ones(3), "can"))
    assert solid.is_watertight
    assert solid.volume == pytest.approx(8.0, rel=0.1)


def test_ties_at_the_level_do_not_open_the_mesh() -> None:
    grid = (np.round(np.random.default_rng(0).random((32, 32, 32)) * 2) / 2).astype(np.float32)
    grid *= np.sqrt(X**2 + Y**2 + Z**2) < 0.8
    assert _trimesh(mesh_from_grid(grid, np.ones(3), "mug")).is_watertight


def test_thin_handle_survives_and_walls_stay() -> None:
    ring = np.hypot(np.hypot(X - 0.5, Z) - 0.3, Y) - 0.04  # thinner than a voxel: peaks stay under 0.5
    body = np.maximum(np.hypot(X, Y) - 0.5, np.abs(Z) - 0.6)
    grid = np.maximum(_soft(body), 0.45 * np.exp(-np.square(np.maximum(ring, 0) / 0.05)).astype(np.float32))
    mesh = mesh_from_grid(grid, np.ones(3), "mug")
    assert mesh.vertices[:, 0].max() == pytest.approx(0.84, abs=0.06)
    assert mesh.vertices[:, 0].min() == pytest.approx(-0.5, abs=0.02)
    plain = mesh_from_grid(grid, np.ones(3), "mug", MeshConfig(ridge=1.0))
    assert plain.vertices[:, 0].max() < 0.6  # what a fixed level makes of it


@pytest.mark.parametrize("radius", [0.52, 0.545, 0.58])
def test_walls_thinner_than_a_voxel_have_no_holes(radius) -> None:
    thickness, fine = 0.05, (np.arange(192) + 0.5) / 96 - 1  # 0.8 of a voxel: nearly full, or halves in two
    x, y, z = np.meshgrid(fine, fine, fine, indexing="ij", sparse=True)
    r = np.hypot(x, y)
    cup = (np.abs(r - radius) < thickness / 2) & (np.abs(z) < 0.7) | (r < radius) & (np.abs(z + 0.6) < 0.1)
    grid = cup.reshape(32, 6, 32, 6, 32, 6).mean(axis=(1, 3, 5)).astype(np.float32)
    solid = _trimesh(mesh_from_grid(grid, np.ones(3), "bowl"))
    assert solid.euler_number == 2  # a cup is a ball, folded
    assert solid.volume == pytest.approx(8 * cup.mean(), rel=0.15)
    vertices, faces, _, _ = marching_cubes(sharpen(grid, MeshConfig()), 0.5)
    assert trimesh.Trimesh(vertices, faces, process=False).euler_number < 0  # what it would be otherwise


def test_only_the_largest_piece_is_kept() -> None:
    grid = np.maximum(
        _soft(np.sqrt(X**2 + Y**2 + Z**2) - 0.5), _soft(np.abs(X - 0.85) + np.abs(Y) + np.abs(Z) - 0.1)
    )
    assert mesh_from_grid(grid, np.ones(3), "bowl").vertices[:, 0].max() < 0.6


def test_empty_grid_is_an_error() -> None:
    with pytest.raises(EmptyShapeError, match="nothing to mesh"):
        mesh_from_grid(np.zeros((32, 32, 32), np.float32), np.ones(3), "mug")


def test_mesh_from_code_decodes(decoder) -> None:
    code = np.zeros(16)
    mesh = mesh_from_code(decoder, "can", code, np.full(3, 0.1))
    assert np.ptp(mesh.vertices[:, 2]) == pytest.approx(2 * 0.75 * 0.1, rel=0.02)


def test_voxelise_and_mesh_undo_each_other() -> None:
    ball = trimesh.creation.icosphere(3, 0.04)
    ball.apply_translation([0.005, 0.0, -0.01])
    grid = voxelise(TriangleMesh(ball.vertices, ball.faces), np.full(3, 0.06))
    assert grid.sum() * (2 * 0.06 / 32) ** 3 == pytest.approx(ball.volume, rel=0.01)
    back = _trimesh(mesh_from_grid(grid, np.full(3, 0.06), "can"))
    np.testing.assert_allclose(back.bounds, ball.bounds, atol=0.001)
