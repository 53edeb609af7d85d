"""Convex pieces of reconstructed meshes that keep cavities open.

Decompositions of meshes fill cavities and rock on the table. Here the mesh is measured in polar coordinates
about its body's axis, and the pieces are built from the measured radii: a stack of frusta where the body is
solid, rings of wall segments where it is hollow, and a chain of short pieces along a mug's handle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError

from perception.mesh_sections import cross_section
from perception.types import Category, TriangleMesh
from sim_assets.objects.convex.perceived_handle import handle_pieces
from sim_assets.objects.convex.pieces import CLEARANCE, breakpoints

Piece = Float[np.ndarray, "_n 3"]

AROUND = 24  # wall segments of a ring
SAMPLES = 5  # azimuths measured for each segment
LEVELS = 56  # heights measured
MOST_LEVELS, MOST_SLICES = 7, 12  # of wall segments, of frusta, above each other
TOLERANCE = 4e-4  # [m], tolerance of the pieces about the measured profile
LEAST_COVERED = 0.2  # share of azimuths that must hit the mesh for a height to be used
CORRECTIONS, DAMPING = 5, 0.75  # iterations of the volume correction, of which the best is used
THICKER, FATTER = (0.85, 1.15), (0.985, 1.015)  # bounds per iteration for walls, for closed bodies
STRAYED = 0.05  # relative to an extent: larger errors indicate that the mesh is no body about an axis
OPEN_SHARE = 0.8  # share of azimuths with a free axis for a height to count as cavity
LEAST_FLOOR = 8e-4  # [m], smallest floor thickness of a vessel
EDGE = 2e-4  # [m], height of the transition between a floor of that thickness and the wall
LEAST_CAVITY = 0.002  # [m] of depth: shallower hollows are filled
# The thickness of a wall determines its volume: tighter tolerance than for its position.
THICKNESS_WEIGHT = 3.0
HANDLE_SECTOR = np.deg2rad(50)  # around a mug's +x, where the body's radius is interpolated
FOOT = 1.2e-3  # [m] above the lowest point at which the base is measured: meshes have rounded edges


@dataclass(frozen=True)
class PolarBody:
    """A body measured about its axis, handle left out.

    Attributes:
        axis: (x, y) of the axis in the object frame [m].
        z: heights [m], ascending; the first is the mesh's lowest point, the last its highest.
        inner: radius of the cavity at each height and segment boundary [m]; 0 where solid.
        outer: radius of the body there [m].
        dome: index into ``z`` of the top of a hollow under the base; 0 for a flat base.
        floor: index of the cavity's floor; the last index for a body without one.
    """

    axis: Float[np.ndarray, "2"]
    z: Float[np.ndarray, "z"]
    inner: Float[np.ndarray, "z k"]
    outer: Float[np.ndarray, "z k"]
    dome: int
    floor: int


def perceived_pieces(mesh: TriangleMesh, category: Category, axis: Float[np.ndarray, "2"]) -> list[Piece]:
    """Return corners of convex pieces in the mesh's frame (z up) whose union approximates the object.

    The thickness of walls, or the radius of a solid body, is adjusted to the mesh's volume. A mesh that is
    no body about an axis, such as a fragment of one, is cut into slices instead; one with parts that have no
    thickness is replaced by its hull.

    Raises:
        QhullError: The vertices lie in a plane.
    """
    try:
        pieces = _polar_pieces(mesh, category, axis)
        strays = np.abs(np.ptp(np.concatenate(pieces), axis=0) / np.ptp(mesh.vertices, axis=0) - 1).max()
        return pieces if strays < STRAYED else _slices(mesh)
    except QhullError:
        return [mesh.vertices[ConvexHull(mesh.vertices).vertices]]


def _polar_pieces(mesh: TriangleMesh, category: Category, axis: np.ndarray) -> list[Piece]:
    body = measure(mesh, category, axis)
    handle = handle_pieces(mesh, body.axis, body.z, body.outer[:, 0]) if category == "mug" else []
    volume = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume - pieces_volume(handle)
    best, least = [], np.inf
    for _ in range(CORRECTIONS):
        solid, walls = _solids(body), _walls(body)
        missing = volume - pieces_volume(solid + walls)
        if abs(missing) < least:
            best, least = solid + walls, abs(missing)
        if body.z[-1] - body.z[body.floor] > 0.25 * np.ptp(body.z):
            factor = np.clip(1 + DAMPING * missing / pieces_volume(walls), *THICKER)
            body = replace(body, inner=body.outer - factor * (body.outer - body.inner))
        else:
            factor = np.sqrt(np.clip(1 + DAMPING * missing / pieces_volume(solid + walls), *FATTER))
            body = replace(body, inner=factor * body.inner, outer=factor * body.outer)
    return best + handle


def _slices(mesh: TriangleMesh) -> list[Piece]:
    """Return the hulls of horizontal slices of the mesh; hollows are filled."""
    z = mesh.vertices[:, 2]
    heights = np.linspace(z.min(), z.max(), MOST_LEVELS + 2)
    cuts = [
        cross_section(mesh.vertices, mesh.faces, float(height)).reshape(-1, 2) for height in heights[1:-1]
    ]
    rings = [np.column_stack([xy, np.full(len(xy), up)]) for xy, up in zip(cuts, heights[1:-1], strict=True)]
    edges = [np.zeros((0, 3)), *rings, np.zeros((0, 3))]
    between = [mesh.vertices[(z >= low) & (z <= high)] for low, high in pairwise(heights)]
    points = [
        np.concatenate([low, part, high]) for part, (low, high) in zip(between, pairwise(edges), strict=True)
    ]
    return [corners[ConvexHull(corners).vertices] for corners in points]


def pieces_volume(pieces: Sequence[Piece]) -> float:
    """Return the sum of the pieces' volumes in [m³], neglecting overlaps."""
    return float(sum(ConvexHull(piece).volume for piece in pieces))


def measure(mesh: TriangleMesh, category: Category, axis: Float[np.ndarray, "2"]) -> PolarBody:
    """Measure the body in polar coordinates about its axis."""
    low, high = float(mesh.vertices[:, 2].min()), float(mesh.vertices[:, 2].max())
    edge = min(FOOT, 0.02 * (high - low))
    z = np.linspace(low + edge, high - edge, LEVELS)
    azimuths = 2 * np.pi * np.arange(AROUND * SAMPLES) / (AROUND * SAMPLES)
    inner, outer = _radii(mesh, axis, z, azimuths)
    shown = np.ones(len(azimuths), dtype=bool)
    if category == "mug":
        shown = np.abs((azimuths + np.pi) % (2 * np.pi) - np.pi) >= HANDLE_SECTOR
        inner[:, ~shown] = outer[:, ~shown] = np.nan
    covered = np.isfinite(outer[:, shown]).mean(axis=1)
    usable = covered > LEAST_COVERED
    if usable.sum() < 3:
        usable[:], outer[:] = True, np.ptp(mesh.vertices[:, :2], axis=0).mean() / 2
        inner[:], covered[:] = 0.0, 1.0
    z, inner, outer, covered = z[usable], inner[usable], outer[usable], covered[usable, None]
    opened = (np.nan_to_num(inner) > 0).sum(axis=1) > OPEN_SHARE * np.isfinite(inner).sum(axis=1)
    floor, dome = _cavity(opened, z), len(z) - 1 - _cavity(opened[::-1], -z[::-1])
    thin = bool(opened.all())  # a floor below the first height
    if thin:
        floor, dome = 1, 0
    inner, outer = _filled(inner), _filled(outer)
    inner[dome : floor + 1] = 0.0
    # A ragged rim or uneven base has gaps; closing them would enclose more volume than the mesh.
    inner, outer = (
        np.where(inner > 0, outer - covered * (outer - inner), 0),
        np.where(inner > 0, outer, np.sqrt(covered) * outer),
    )
    z[0], z[-1] = low, high
    if thin:
        floor_height = _floor_thickness(mesh, axis, 0.5 * float(inner[2].mean()))
        z[1] = low + min(max(floor_height, LEAST_FLOOR), z[1] - low)
        z[2] = max(z[1], low + CLEARANCE) + EDGE
    return PolarBody(axis, z, _by_segment(inner), _by_segment(outer), dome, floor)


def _floor_thickness(mesh: TriangleMesh, axis: Float[np.ndarray, "2"], radius: float) -> float:
    """Return the mean thickness of the lowest layer around the axis [m]."""
    near = np.linalg.norm(mesh.vertices[:, :2] - axis, axis=1) < radius
    heights = np.sort(mesh.vertices[near, 2])
    if len(heights) < 8:
        return 0.0
    lower, upper = np.array_split(heights, 2)
    return float(np.median(upper) - np.median(lower))


def _radii(
    mesh: TriangleMesh, axis: np.ndarray, z: np.ndarray, azimuths: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return radii (z, azimuths) of the cavity, 0 where the axis is in material, and the outside; or NaN."""
    outward = np.stack([np.cos(azimuths), np.sin(azimuths)])
    beside = np.stack([-outward[1], outward[0]])
    inner = np.full((len(z), len(azimuths)), np.nan)
    outer = inner.copy()
    for row, height in enumerate(z):
        ends = cross_section(mesh.vertices, mesh.faces, float(height)) - axis
        side, along = ends @ beside, ends @ outward  # (segments, 2, azimuths)
        crossed = (side[:, 0] >= 0) != (side[:, 1] >= 0)
        share = side[:, 0] / np.where(crossed, side[:, 0] - side[:, 1], 1.0)
        hits = along[:, 0] + share * (along[:, 1] - along[:, 0])
        hits = np.where(crossed & (hits > 0), hits, np.nan)
        found = np.isfinite(hits).sum(axis=0)
        some = found > 0
        if not some.any():
            continue
        outer[row, some] = np.nanmax(hits[:, some], axis=0)
        inner[row, some] = np.where(found[some] % 2 == 1, 0.0, np.nanmin(hits[:, some], axis=0))
    return inner, outer


def _cavity(opened: Bool[np.ndarray, "z"], z: Float[np.ndarray, "z"]) -> int:
    """Return the index of the height where the cavity open to the end begins; without a cavity, the last."""
    closed = np.flatnonzero(~opened)
    begin = int(closed[-1]) if len(closed) else 0
    return begin if begin < len(z) - 2 and z[-1] - z[begin] > LEAST_CAVITY else len(z) - 1


def _filled(radii: Float[np.ndarray, "z a"]) -> Float[np.ndarray, "z a"]:
    """Fill gaps in each row by linear interpolation around the circle."""
    filled = radii.copy()
    columns = np.arange(radii.shape[1])
    for row in filled:
        known = np.isfinite(row)
        row[:] = np.interp(columns, columns[known], row[known], period=len(columns))
    return filled


def _by_segment(radii: Float[np.ndarray, "z a"]) -> Float[np.ndarray, "z k"]:
    """Return radii at the segments' boundaries, enlarged so that the polygon has the measured area."""
    around = radii.shape[1] // SAMPLES
    half = SAMPLES // 4
    windows = np.stack([np.roll(radii, shift, axis=1) for shift in range(-half, half + 1)])
    mean = np.sqrt((windows**2).mean(axis=0))[:, ::SAMPLES]
    step = 2 * np.pi / around
    return mean * np.sqrt(step / np.sin(step))


def _ring(body: PolarBody, radii: np.ndarray, z: float) -> Float[np.ndarray, "k 3"]:
    """Return the points at the segment boundaries of one height."""
    azimuths = 2 * np.pi * np.arange(len(radii)) / len(radii)
    xy = body.axis + radii[:, None] * np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
    return np.column_stack([xy, np.full(len(radii), z)])


def _levels(body: PolarBody, low: int, high: int) -> list[int]:
    """Return the indices of the heights at which the mean profile bends or, for solids, that of any side."""
    rows = slice(low, high + 1)
    inner, outer = body.inner[rows].mean(axis=1), body.outer[rows].mean(axis=1)
    solid = not inner.any()
    sides = body.outer[rows, :: AROUND // 4] if solid else THICKNESS_WEIGHT * (outer - inner)[:, None]
    profile = np.column_stack([outer, sides, body.z[rows]])
    return [low + int(i) for i in breakpoints(profile, TOLERANCE, MOST_SLICES if solid else MOST_LEVELS)]


def _solids(body: PolarBody) -> list[Piece]:
    """Build frusta where the axis is inside the material, and a flat foot under a hollow base.

    A foot ring alone would slide slowly over the table.
    """
    rings = [_ring(body, body.outer[i], body.z[i]) for i in _levels(body, body.dome, body.floor)]
    pieces = [np.concatenate(pair) for pair in pairwise(rings)]
    if body.dome:
        pieces.append(np.concatenate([_ring(body, body.outer[0], body.z[0] + up) for up in (0, CLEARANCE)]))
    return pieces


def _walls(body: PolarBody) -> list[Piece]:
    """Build rings of wall segments, above the ground so that only the base touches it."""
    pieces: list[Piece] = []
    for low, high in ((0, body.dome), (body.floor, len(body.z) - 1)):
        for first, last in pairwise(_levels(body, low, high)) if high > low else ():
            pieces += _segments(body, first, last)
    return pieces


def _segments(body: PolarBody, first: int, last: int) -> list[Piece]:
    """Build one ring of segments between two heights."""
    corners = []
    for i in (first, last):
        z = max(body.z[i], body.z[0] + CLEARANCE)
        corners += [_ring(body, np.maximum(body.inner[i], 0.0), z), _ring(body, body.outer[i], z)]
    around = body.inner.shape[1]
    return [np.concatenate([ring[[k, (k + 1) % around]] for ring in corners]) for k in range(around)]
