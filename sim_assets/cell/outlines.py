"""Horizontal outlines of objects, and the distances between them."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import cv2
import numpy as np
import trimesh
from jaxtyping import Float

OUTLINE_CELL = 0.001  # [m] raster on which an outline is traced

# Outlines of the meshes that are in use: a cache that kept the meshes would grow by 5 MB with each.
_outlines: WeakKeyDictionary[trimesh.Trimesh, Float[np.ndarray, "n 2"]] = WeakKeyDictionary()


def outline(mesh: trimesh.Trimesh) -> Float[np.ndarray, "n 2"]:
    """Return the horizontal outline of a mesh: a polygon in the object frame, to half a millimetre."""
    known = _outlines.get(mesh)
    if known is None:
        known = _outlines[mesh] = _traced(mesh)
    return known


def _traced(mesh: trimesh.Trimesh) -> Float[np.ndarray, "n 2"]:
    low = mesh.bounds[0, :2] - 3 * OUTLINE_CELL
    size = np.ceil((mesh.bounds[1, :2] - low) / OUTLINE_CELL).astype(int) + 3
    # the union of their projections is the outline
    upward = mesh.faces[mesh.face_normals[:, 2] > 0] if mesh.is_watertight else mesh.faces
    triangles = (mesh.vertices[upward][..., :2] - low) / OUTLINE_CELL
    image = np.zeros((size[1], size[0]), dtype=np.uint8)
    fraction = 4  # cv2 takes fixed-point corners
    for triangle in np.round(triangles * 2**fraction).astype(np.int32):
        cv2.fillConvexPoly(image, triangle, 255, shift=fraction)
    contours, _ = cv2.findContours(image, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(contours, key=len)[:, 0, :]
    polygon = cv2.approxPolyDP(largest.astype(np.int32), 0.5, True)[:, 0, :]
    polygon = polygon * OUTLINE_CELL + low
    polygon.flags.writeable = False
    return polygon


def gap(first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "m 2"]) -> float:
    """Return the distance between two polygons in [m]; 0 where they overlap."""
    if contains(first, second[0]) or contains(second, first[0]):
        return 0.0
    if _edges_cross(first, second):
        return 0.0
    return float(min(distances_to(first, second).min(), distances_to(second, first).min()))


def contains(polygon: Float[np.ndarray, "n 2"], point: Float[np.ndarray, "2"]) -> bool:
    """Return whether a point is inside a polygon: a ray from it crosses an odd number of edges."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    crosses = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
    run = np.where(crosses, b[:, 1] - a[:, 1], 1.0)
    x = a[:, 0] + (point[1] - a[:, 1]) / run * (b[:, 0] - a[:, 0])
    return bool(np.count_nonzero(crosses & (point[0] < x)) % 2)


def _edges_cross(first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "m 2"]) -> bool:
    a, b = first[:, None], np.roll(first, -1, axis=0)[:, None]
    c, d = second[None], np.roll(second, -1, axis=0)[None]

    def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
        u, v = q - p, r - p
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0] > 0

    return bool(((side(a, b, c) != side(a, b, d)) & (side(c, d, a) != side(c, d, b))).any())


def distances_to(points: Float[np.ndarray, "n 2"], polygon: Float[np.ndarray, "m 2"]) -> np.ndarray:
    """Return the (n, m) distances of points to a polygon's edges."""
    a, edge = polygon[None], (np.roll(polygon, -1, axis=0) - polygon)[None]
    to_point = points[:, None] - a
    along = np.clip((to_point * edge).sum(-1) / np.maximum((edge**2).sum(-1), 1e-18), 0, 1)
    return np.linalg.norm(to_point - along[..., None] * edge, axis=-1)
