"""Texture coordinates of meshes: once around z, or along the faces of a box into the cells of an atlas.

An atlas is one texture of ATLAS[0] x ATLAS[1] cells, counted along the rows from the bottom left.
"""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float, Int

ATLAS = (2, 3)  # rows, columns of cells
CELLS = ATLAS[0] * ATLAS[1]
MARGIN = 0.02  # of a cell, kept free at each edge against bleeding from its neighbours
ATTRIBUTE = "uv"  # (F, 3, 2) face attribute of meshes that bring their own coordinates


def around(mesh: trimesh.Trimesh) -> Float[np.ndarray, "c 2"]:
    """Return a mesh's texture coordinates by face corner: once around z horizontally, upwards vertically.

    Returns:
        (3 F, 2), face by face; a face across the seam exceeds 1 instead of spanning the texture backwards.
    """
    corners = mesh.vertices[mesh.faces]
    u = np.arctan2(corners[..., 1], corners[..., 0]) / (2 * np.pi) + 0.5
    u = np.where((u.max(axis=1, keepdims=True) - u) > 0.5, u + 1, u)
    low, high = mesh.bounds[:, 2]
    v = (corners[..., 2] - low) / max(high - low, 1e-9)
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def along_faces(mesh: trimesh.Trimesh) -> tuple[Float[np.ndarray, "f 3 2"], Int[np.ndarray, "f"]]:
    """Project each triangle along the axis that its normal is closest to.

    Returns:
        (F, 3, 2) coordinates in 0..1 over the mesh's bounding box, upwards on upright faces and not mirrored
        seen from outside; (F,) the axes 0, 1, 2.
    """
    normals = mesh.face_normals
    axis = np.abs(normals).argmax(axis=1)
    sign = np.sign(np.take_along_axis(normals, axis[:, None], axis=1))
    low, high = mesh.bounds
    unit = (mesh.vertices[mesh.faces] - low) / np.maximum(high - low, 1e-9)
    right, up = np.array([1, 0, 0])[axis], np.array([2, 2, 1])[axis]
    u = np.take_along_axis(unit, right[:, None, None], axis=2)[..., 0]
    v = np.take_along_axis(unit, up[:, None, None], axis=2)[..., 0]
    mirrored = np.array([1, -1, 1])[axis][:, None] * sign < 0
    return np.stack([np.where(mirrored, 1 - u, u), v], axis=-1), axis


def in_cell(unit: Float[np.ndarray, "f 3 2"], cell: Int[np.ndarray, "#f"]) -> Float[np.ndarray, "f 3 2"]:
    """Return coordinates in 0..1 moved into cells of the atlas."""
    corner = np.stack([cell % ATLAS[1], cell // ATLAS[1]], axis=-1)[:, None]
    return (corner + MARGIN + (1 - 2 * MARGIN) * unit) / (ATLAS[1], ATLAS[0])


def faces(mesh: trimesh.Trimesh, first: int = 0) -> Float[np.ndarray, "f 3 2"]:
    """Return coordinates with cells first, first + 1, first + 2 on the faces across x, y and z."""
    unit, axis = along_faces(mesh)
    return in_cell(unit, axis + first)
