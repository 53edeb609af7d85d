"""Convex collision pieces, and the primitives and polyline approximation of all decompositions."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float

from sim_assets.objects.solids import Section

PieceKind = Literal["box", "cylinder", "capsule", "mesh"]
CLEARANCE = 0.0018  # height of the lowest ring segment above the base [m]
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class CollisionPiece:
    """One convex piece in the object frame.

    Attributes:
        kind: "box", "cylinder", "capsule" (both along their own z) or "mesh".
        position: (3,) centre [m]; zero for a mesh.
        quat_wxyz: (4,) orientation.
        size: MuJoCo's half-sizes [m]: box (x, y, z), cylinder and capsule (radius, half length).
        vertices: (n, 3) corners of a mesh, whose convex hull is the piece [m]; (0, 3) for the others.
    """

    kind: PieceKind
    position: Float[np.ndarray, "3"]
    quat_wxyz: Float[np.ndarray, "4"]
    size: tuple[float, ...]
    vertices: Float[np.ndarray, "n 3"] = field(default_factory=lambda: np.zeros((0, 3)))


def hull(vertices: Float[np.ndarray, "n 3"]) -> CollisionPiece:
    """Return the convex hull of points of the object frame."""
    return CollisionPiece("mesh", np.zeros(3), IDENTITY, (), np.asarray(vertices, dtype=np.float64))


def cylinder(radius: float, bottom: float, top: float) -> CollisionPiece:
    """Return an upright cylinder about the object's axis."""
    position = np.array([0.0, 0.0, 0.5 * (bottom + top)])
    return CollisionPiece("cylinder", position, IDENTITY, (radius, 0.5 * (top - bottom)))


def frustum(
    bottom: tuple[float, float],
    top: tuple[float, float],
    section: Section | None = None,
    around: int = 32,
    phase: float = 0.5,
) -> CollisionPiece:
    """Return the hull of two rings (radius, z), circular or of the section's shape.

    Args:
        bottom, top: radius and height of the rings [m].
        section: horizontal section; None for a circle.
        around: number of corners of a ring.
        phase: azimuth of the first corner, as a share of the angle between corners.
    """
    angle = 2 * np.pi * (np.arange(around) + phase) / around
    cos, sin = np.cos(angle), np.sin(angle)
    rings = []
    for radius, z in (bottom, top):
        # equal areas outside and inside the circle
        r = np.full(around, radius / np.sqrt(np.cos(np.pi / around)))
        if section is not None:
            r = radius * (1.0 + section.weight(np.array([z])) * section.modulation(cos, sin))
        rings.append(np.stack([r * cos, r * sin, np.full(around, z)], axis=1))
    return hull(np.concatenate(rings))


def breakpoints(curve: Float[np.ndarray, "k d"], tolerance: float, most: int) -> np.ndarray:
    """Return the indices of the points of a polyline of at most `most` segments along a curve.

    The curve is split at the point farthest from its chord until all are within the tolerance [m].
    """
    chosen = [0, len(curve) - 1]
    while len(chosen) <= most:
        worst, where = tolerance, -1
        for first, last in pairwise(chosen):
            chord = curve[last] - curve[first]
            offset = curve[first : last + 1] - curve[first]
            along = offset @ chord / max(float(chord @ chord), 1e-12)
            away = np.linalg.norm(offset - along[:, None] * chord, axis=1)
            if away.max() > worst:
                worst, where = float(away.max()), first + int(away.argmax())
        if where < 0:
            break
        chosen = sorted([*chosen, where])
    return np.array(chosen)
