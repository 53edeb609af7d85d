"""Occupancy grid of a watertight mesh by the parity of surface crossings along vertical lines."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from perception.types import GRID_RESOLUTION, TriangleMesh

_JITTER = (
    1.7e-4,
    2.9e-4,
)  # of a cell: keeps lines off vertices and edges, where a crossing would count twice


def voxelise(
    mesh: TriangleMesh, scale: Float[np.ndarray, "3"], supersample: int = 2
) -> Float[np.ndarray, "32 32 32"]:
    """Return the fraction of every voxel that lies inside the mesh.

    Args:
        mesh: Watertight mesh in the object frame, in metres.
        scale: (3,) metres per canonical unit; the mesh must fit into the cube.
        supersample: Number of samples per voxel and axis.
    """
    n = GRID_RESOLUTION * supersample
    points = (mesh.vertices / scale + 1) * n / 2 - 0.5  # in fine cells, whose centres are at integers
    column, height = _crossings(points, mesh.faces, n)
    above = np.clip(np.ceil(height), 0, n).astype(int)  # the first cell centre over the crossing
    flips = np.bincount(column * (n + 1) + above, minlength=n * n * (n + 1)).reshape(n, n, n + 1)
    inside = np.cumsum(flips, axis=2)[:, :, :n] % 2
    r = GRID_RESOLUTION
    blocks = inside.reshape(r, supersample, r, supersample, r, supersample)
    return blocks.mean(axis=(1, 3, 5)).astype(np.float32)


def voxels_of(mesh: TriangleMesh) -> tuple[Float[np.ndarray, "32 32 32"], Float[np.ndarray, "3"]]:
    """Return the occupancy of a watertight mesh and the scale [m] with which it fits into the cube.

    The cube is centred at the mesh's origin, with the usual margin of the grids.
    """
    scale = np.maximum(np.abs(mesh.vertices).max(axis=0) / 0.9, 1e-3)
    return voxelise(mesh, scale), scale


def _crossings(
    points: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], n: int
) -> tuple[Int[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Return the crossings of vertical lines with triangles: line ix * n + iy, and height."""
    corners = points[faces]  # (f, 3, 3)
    low = np.clip(np.ceil(corners[:, :, :2].min(axis=1) - _JITTER), 0, n).astype(int)
    high = np.clip(np.floor(corners[:, :, :2].max(axis=1) - _JITTER), -1, n - 1).astype(int)
    size = np.maximum(high - low + 1, 0)
    count = size[:, 0] * size[:, 1]
    face = np.repeat(np.arange(len(faces)), count)
    within = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    ix = low[face, 0] + within // size[face, 1]
    iy = low[face, 1] + within % size[face, 1]
    a, b, c = corners[face, 0], corners[face, 1], corners[face, 2]
    x, y = ix + _JITTER[0], iy + _JITTER[1]
    area = _cross(b - a, c - a)
    safe = np.where(area == 0, 1.0, area)  # triangles seen edge-on are never hit
    wb = ((x - a[:, 0]) * (c - a)[:, 1] - (y - a[:, 1]) * (c - a)[:, 0]) / safe
    wc = ((b - a)[:, 0] * (y - a[:, 1]) - (b - a)[:, 1] * (x - a[:, 0])) / safe
    hit = (area != 0) & (wb >= 0) & (wc >= 0) & (wb + wc <= 1)
    z = a[:, 2] + wb * (b - a)[:, 2] + wc * (c - a)[:, 2]
    return (ix * n + iy)[hit], z[hit]


def _cross(p: Float[np.ndarray, "k 3"], q: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k"]:
    return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
