"""Convex pieces of a solid given as points, which together cover it and little of the free space around it.

The solid is cut by planes across its principal directions, the piece that covers most free space first, where
the hulls of the two parts are smallest (a plain form of approximate convex decomposition; Lien and Amato,
"Approximate convex decomposition of polyhedra", 2007).
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from perception.obstacles.obstacle import thickened
from perception.obstacles.volume import Solid

FLAT = 0.1  # thickness, in voxels, below which a sheet of voxels is taken for flat
_CUTS = np.linspace(0.1, 0.9, 5)  # candidate planes, as shares of the extent
_FACETS = 24  # against which points are tested at once: most are outside the first ones


@dataclass(frozen=True)
class ConvexConfig:
    """Parameters of the pieces.

    Attributes:
        max_pieces: Largest number of pieces.
        max_free: Largest share of a piece that may be free space.
        min_free: Free space that is always accepted, in cubic metres.
        forbidden_weight: Weight of a forbidden point relative to that of a free voxel.
        voxel: Edge length of the solid's voxels in metres.
    """

    max_pieces: int = 16
    max_free: float = 0.10
    min_free: float = 4e-6
    forbidden_weight: float = 4.0
    voxel: float = 0.005


@dataclass(frozen=True)
class _Piece:
    points: Float[np.ndarray, "n 3"]
    hull: ConvexHull
    excess: float  # free space in it [m³]

    @property
    def vertices(self) -> Float[np.ndarray, "k 3"]:
        return self.hull.points[self.hull.vertices]


def convex_pieces(
    solid: Solid,
    forbidden: Float[np.ndarray, "f 3"] = np.zeros((0, 3)),
    config: ConvexConfig = ConvexConfig(),
) -> tuple[Float[np.ndarray, "_k 3"], ...]:
    """Return the vertices of convex pieces [m] that cover the solid.

    Args:
        solid: Solid and free space.
        forbidden: Points that should be outside all pieces: the surfaces of known objects.
        config: Parameters.
    """
    if not len(solid.points):
        return ()
    axes = _principal_axes(solid.points)
    pieces = [_piece(solid.points, solid, forbidden, config)]
    while len(pieces) < config.max_pieces:
        worst = max(pieces, key=lambda piece: piece.excess)
        if worst.excess <= max(config.min_free, config.max_free * worst.hull.volume):
            break
        parts = _best_cut(worst.points, axes, config)
        if parts is None:
            break
        pieces = [piece for piece in pieces if piece is not worst]
        pieces += [_piece(part, solid, forbidden, config) for part in parts]
    return tuple(piece.vertices for piece in pieces)


def _piece(
    points: Float[np.ndarray, "n 3"], solid: Solid, forbidden: np.ndarray, config: ConvexConfig
) -> _Piece:
    hull = _hull(points, config.voxel)
    # Voxels beside the surface are partly solid: those whose whole sphere lies in the hull are free space.
    free = _inside(hull, solid.free, config.voxel / 2) * config.voxel**3
    touched = _inside(hull, forbidden, 0.0) * config.forbidden_weight * config.voxel**3
    return _Piece(points, hull, free + touched)


def _hull(points: Float[np.ndarray, "n 3"], voxel: float) -> ConvexHull:
    """Return the convex hull; that of whole voxels where the points span hardly any volume."""
    with contextlib.suppress(QhullError):
        hull = ConvexHull(points)
        if 2 * hull.volume >= FLAT * voxel * hull.area:  # of a sheet, the area counts both sides
            return hull
    return ConvexHull(thickened(points, voxel))


def _inside(hull: ConvexHull, points: Float[np.ndarray, "n 3"], depth: float) -> int:
    """Return the number of points that lie more than ``depth`` metres inside the hull."""
    low, high = hull.min_bound, hull.max_bound
    near = points[((points > low) & (points < high)).all(axis=1)]
    n_groups = -(-len(hull.equations) // _FACETS)
    for group in range(n_groups):
        facets = hull.equations[group::n_groups]
        near = near[(near @ facets[:, :3].T + facets[:, 3] < -depth).all(axis=1)]
    return len(near)


def _best_cut(
    points: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "3 3"], config: ConvexConfig
) -> tuple[Float[np.ndarray, "_a 3"], Float[np.ndarray, "_b 3"]] | None:
    """Return the two parts with the smallest hulls; None if the points cannot be cut."""
    best, parts = np.inf, None
    for along in (points @ axes.T).T:
        low, high = along.min(), along.max()
        if high - low < 2 * config.voxel:
            continue
        for level in low + _CUTS * (high - low):
            below = along < level
            if not below.any() or below.all():
                continue
            volume = sum(_hull(points[side], config.voxel).volume for side in (below, ~below))
            if volume < best:
                best, parts = volume, (points[below], points[~below])
    return parts


def _principal_axes(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the principal horizontal directions and the vertical, as rows."""
    plan = points[:, :2] - points[:, :2].mean(axis=0)
    axes = np.eye(3)
    axes[:2, :2] = np.linalg.eigh(plan.T @ plan)[1].T
    return axes
