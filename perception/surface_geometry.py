"""Areas, normals, edges and the centre of mass of triangle meshes, with numpy alone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from perception.types import TriangleMesh

_TINY = 1e-13  # lengths up to which a vector has no direction
_FLAT = 1e-8  # [rad]; angles up to which a triangle is degenerate


def surface_area(mesh: TriangleMesh) -> float:
    """Return the area of all triangles, in m²."""
    return float(0.5 * np.linalg.norm(_crosses(mesh), axis=1).sum())


def vertex_normals(mesh: TriangleMesh) -> Float[np.ndarray, "v 3"]:
    """Return the unit normal of each vertex: the mean over its triangles, weighted by their angles there.

    Degenerate triangles do not count (Thürmer and Wüthrich, "Computing Vertex Normals from Polygonal Facets",
    1998). A vertex of no other triangle has a zero vector.
    """
    corners = mesh.vertices[mesh.faces]  # (f, 3 corners, 3)
    u, v, w = (_unit(corners[:, end] - corners[:, start]) for start, end in ((0, 1), (0, 2), (1, 2)))
    angles = np.arccos(np.clip([(u * v).sum(1), -(u * w).sum(1)], -1, 1))
    angles = np.vstack([angles, np.pi - angles.sum(0)])  # (3 corners, f)
    angles[:, (angles < _FLAT).any(0)] = 0.0
    weighted = angles[..., None] * _unit(_crosses(mesh))  # (3 corners, f, 3)
    at = mesh.faces.T.ravel()
    sums = [np.bincount(at, weighted[..., k].ravel(), len(mesh.vertices)) for k in range(3)]
    return _unit(np.stack(sums, axis=-1))


def mesh_edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """Return each edge once, as the indices of its vertices in ascending order."""
    ends = np.sort(np.concatenate([faces[:, (0, 1)], faces[:, (1, 2)], faces[:, (2, 0)]]), axis=1)
    n = int(faces.max(initial=0)) + 1
    keys = np.unique(ends[:, 0] * n + ends[:, 1])
    return np.stack([keys // n, keys % n], axis=1)


def centre_of_mass(mesh: TriangleMesh) -> Float[np.ndarray, "3"]:
    """Return the centre of mass of a closed mesh's volume."""
    corners = mesh.vertices[mesh.faces] - mesh.vertices[:1]
    sixfold = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return mesh.vertices[0] + sixfold @ corners.sum(axis=1) / (4 * sixfold.sum())


def _crosses(mesh: TriangleMesh) -> Float[np.ndarray, "f 3"]:
    """Return the outward normals of the triangles, of twice their areas' length."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - b)


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return vectors of length 1; tiny ones become zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > _TINY)
