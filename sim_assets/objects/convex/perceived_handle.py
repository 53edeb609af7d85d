"""Convex pieces along a mug's handle: short links between cross-sections of the reconstructed mesh."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Float

from perception.mesh_sections import cross_section, radial_hits
from perception.types import TriangleMesh
from sim_assets.objects.convex.pieces import breakpoints

MOST_LINKS = 8
CORNERS = 8  # number of corners of a cross-section
SPREAD = np.deg2rad(12)  # part of the handle's angle in which its width is measured
THINNEST = 0.004  # [m], width of the handle where the mesh is too thin to measure


def handle_pieces(
    mesh: TriangleMesh,
    axis: Float[np.ndarray, "2"],
    z: Float[np.ndarray, "z"],
    outer: Float[np.ndarray, "z"],
) -> list[Float[np.ndarray, "_n 3"]]:
    """Build links of the handle in the plane y = axis y; none without a protrusion from the body.

    Args:
        mesh: mesh in the object frame, handle along +x.
        axis: (x, y) of the body's axis [m].
        z, outer: heights, and the body's radius towards the handle at each [m].
    """
    vertices = mesh.vertices - np.array([*axis, 0.0])
    segments = cross_section(vertices[:, [0, 2, 1]], mesh.faces, 1e-6)  # in x and z
    beyond = vertices[vertices[:, 0] > np.interp(vertices[:, 2], z, outer) + 2e-3]
    if len(segments) == 0 or len(beyond) < 12:
        return []
    middle = _hole(segments, beyond, z, outer)
    line = _centreline(segments, middle, z, outer)
    if len(line) < 3:
        return []
    chosen = line[breakpoints(line[:, :2], 6e-4, MOST_LINKS)]
    rings = [_cross_section(row, middle, beyond) for row in chosen]
    return [np.concatenate(pair) + np.array([*axis, 0.0]) for pair in pairwise(rings)]


def _hole(
    segments: np.ndarray, beyond: Float[np.ndarray, "n 3"], z: np.ndarray, outer: np.ndarray
) -> Float[np.ndarray, "2"]:
    """Return (x, z) of the centre of the opening between body and handle; of the handle without one."""
    low, high = beyond[:, 2].min(), beyond[:, 2].max()
    openings = []
    for height in np.linspace(low, high, 15)[2:-2]:
        start = float(np.interp(height, z, outer)) + 1e-3
        hits = radial_hits(segments, np.array([start, height]), 0.0)
        if len(hits) >= 2 and hits[0] > 2e-3:
            openings.append((start + 0.5 * hits[0], height, hits[0]))
    if not openings:
        return np.array([float(np.interp(0.5 * (low + high), z, outer)) + 1e-3, 0.5 * (low + high)])
    found = np.array(openings)
    return np.array([np.median(found[:, 0]), np.average(found[:, 1], weights=found[:, 2])])


def _centreline(
    segments: np.ndarray, middle: np.ndarray, z: np.ndarray, outer: np.ndarray
) -> Float[np.ndarray, "_n 4"]:
    """Measure the handle by angle about the opening: x, z of its middle, half thickness, angle."""
    rows = []
    for angle in np.deg2rad(np.arange(-150, 151, 3)):
        hits = radial_hits(segments, middle, float(angle))
        if len(hits) == 0:
            continue
        near, far = (hits[0], hits[1]) if len(hits) % 2 == 0 else (0.0, hits[0])
        point = middle + 0.5 * (near + far) * np.array([np.cos(angle), np.sin(angle)])
        if point[0] > np.interp(point[1], z, outer):
            rows.append((*point, 0.5 * (far - near), angle))
        elif angle < 0:
            rows.clear()  # the wall below the handle, or behind it
        else:
            break
    line = np.array(rows).reshape(-1, 4)
    if len(line):
        line[:, 2] = np.minimum(
            line[:, 2], 1.4 * np.median(line[:, 2])
        )  # cut at a slant where it meets the wall
    return line


def _cross_section(
    row: Float[np.ndarray, "4"], middle: np.ndarray, beyond: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "8 3"]:
    """Return a polygon with the area of an ellipse of the handle's local thickness and width."""
    x, height, half_thickness, angle = row
    away = np.arctan2(beyond[:, 2] - middle[1], beyond[:, 0] - middle[0]) - angle
    near = beyond[np.abs((away + np.pi) % (2 * np.pi) - np.pi) < SPREAD]
    y = near[:, 1] if len(near) > 4 else beyond[:, 1]
    half_width = max(0.5 * np.ptp(y), THINNEST / 2)
    half_thickness = max(half_thickness, THINNEST / 2)
    corner = 2 * np.pi * (np.arange(CORNERS) + 0.5) / CORNERS
    grow = np.sqrt((2 * np.pi / CORNERS) / np.sin(2 * np.pi / CORNERS))
    along = grow * half_thickness * np.cos(corner)
    across = 0.5 * (y.min() + y.max()) + grow * half_width * np.sin(corner)
    return np.stack([x + along * np.cos(angle), across, height + along * np.sin(angle)], axis=1)
