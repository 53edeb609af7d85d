"""Convex collision pieces, made from the same curves as the surfaces.

Contact with analytic pieces is steadier than with decompositions of meshes: a wall is a ring of small convex
pieces whose cavity stays free, and only the base touches the table (rings start `CLEARANCE` above it).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from sim_assets.objects.profiles import Curve
from sim_assets.objects.solids import Handle, Section
from sim_assets.objects.vessel import Vessel

PieceKind = Literal["box", "cylinder", "capsule", "mesh"]
CLEARANCE = 0.0018  # height of the lowest ring segment above the base [m]
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
HANDLE_PIECES = 6


@dataclass(frozen=True)
class CollisionPiece:
    """One convex piece in the object frame.

    Attributes:
        kind: "box", "cylinder", "capsule" (both along their own z) or "mesh".
        position: (3,) centre [m]; zero for a mesh.
        quat_wxyz: (4,) orientation.
        size: half-sizes as MuJoCo has them [m]: box (x, y, z), cylinder and capsule (radius, half length).
        vertices: (n, 3) corners of a mesh, whose convex hull is the piece [m]; (0, 3) for the others.
    """

    kind: PieceKind
    position: Float[np.ndarray, "3"]
    quat_wxyz: Float[np.ndarray, "4"]
    size: tuple[float, ...]
    vertices: Float[np.ndarray, "n 3"] = field(default_factory=lambda: np.zeros((0, 3)))


def hull(vertices: Float[np.ndarray, "n 3"]) -> CollisionPiece:
    """The convex hull of points of the object frame."""
    return CollisionPiece("mesh", np.zeros(3), IDENTITY, (), np.asarray(vertices, dtype=np.float64))


def cylinder(radius: float, bottom: float, top: float) -> CollisionPiece:
    """An upright cylinder about the object's axis."""
    position = np.array([0.0, 0.0, 0.5 * (bottom + top)])
    return CollisionPiece("cylinder", position, IDENTITY, (radius, 0.5 * (top - bottom)))


def frustum(
    bottom: tuple[float, float], top: tuple[float, float], section: Section | None = None, around: int = 24
) -> CollisionPiece:
    """The hull of two rings (radius, z), of the section's shape where there is one."""
    angle = 2 * np.pi * (np.arange(around) + 0.5) / around
    cos, sin = np.cos(angle), np.sin(angle)
    rings = []
    for radius, z in (bottom, top):
        r = np.full(around, radius / np.sqrt(np.cos(np.pi / around)))  # as much outside as inside the circle
        if section is not None:
            r = radius * (1.0 + section.weight(np.array(z)) * section.modulation(cos, sin))
        rings.append(np.stack([r * cos, r * sin, np.full(around, z)], axis=1))
    return hull(np.concatenate(rings))


def breakpoints(curve: Curve, tolerance: float, most: int) -> np.ndarray:
    """Indices of the points that a polyline needs to follow a curve: the farthest point splits, repeatedly."""
    chosen = [0, len(curve) - 1]
    while len(chosen) <= most:
        worst, where = tolerance, -1
        for first, last in zip(chosen[:-1], chosen[1:]):
            chord = curve[last] - curve[first]
            offset = curve[first : last + 1] - curve[first]
            away = np.abs(chord[0] * offset[:, 1] - chord[1] * offset[:, 0]) / max(np.hypot(*chord), 1e-9)
            if away.max() > worst:
                worst, where = float(away.max()), first + int(away.argmax())
        if where < 0:
            break
        chosen = sorted([*chosen, where])
    return np.array(chosen)


def vessel_pieces(vessel: Vessel, around: int, levels: int, tolerance: float = 8e-4) -> list[CollisionPiece]:
    """Wall of `around` pieces on up to `levels` levels, and the base under the floor."""
    start = max(vessel.floor, CLEARANCE)
    z = np.concatenate([[start], vessel.inner[vessel.inner[:, 1] > start + 1e-5, 1]])
    inner = np.stack([vessel.inner_radius(z), z], axis=1)
    chosen = z[breakpoints(inner, tolerance, levels)]
    stretch = 1.0 / np.sqrt(np.cos(np.pi / around))  # half the sagitta outside, half inside
    pieces = []
    for low, high in zip(chosen[:-1], chosen[1:]):
        ends = np.array([low, high])
        r_inner, r_outer = vessel.inner_radius(ends) * stretch, vessel.outer_radius(ends) * stretch
        if high == chosen[-1]:  # at the rim both curves meet: keep the wall's thickness just below it
            below = np.array([vessel.height - _rim_height(vessel)])
            r_inner[1], r_outer[1] = vessel.inner_radius(below)[0], vessel.outer_radius(below)[0]
            r_inner[1], r_outer[1] = r_inner[1] * stretch, r_outer[1] * stretch
        pieces += _ring(r_inner, r_outer, ends, around)
    return [*_base(vessel, start), *pieces]


def _rim_height(vessel: Vessel) -> float:
    """How far below the top the rim's rounding starts [m]."""
    apex = vessel.inner[-1]
    full = np.abs(vessel.inner_radius(vessel.inner[:, 1]) - vessel.outer_radius(vessel.inner[:, 1]))
    at = int(np.argmax(full[::-1] > 0.8 * np.median(full)))
    return float(apex[1] - vessel.inner[len(vessel.inner) - 1 - at, 1])


def _ring(r_inner: np.ndarray, r_outer: np.ndarray, z: np.ndarray, around: int) -> list[CollisionPiece]:
    """Pieces with 8 corners around the axis: boxes where the wall is upright enough, hulls elsewhere."""
    pieces = []
    half = np.pi / around
    upright = np.ptp(r_inner) < 5e-4 and np.ptp(r_outer) < 5e-4
    for azimuth in 2 * np.pi * np.arange(around) / around:
        if upright:
            face_in, face_out = r_inner.mean() * np.cos(half), r_outer.mean() * np.cos(half)
            middle = 0.5 * (face_in + face_out)
            position = np.array([middle * np.cos(azimuth), middle * np.sin(azimuth), z.mean()])
            turn = np.array([np.cos(azimuth / 2), 0.0, 0.0, np.sin(azimuth / 2)])
            size = (0.5 * (face_out - face_in), middle * np.tan(half), 0.5 * (z[1] - z[0]))
            pieces.append(CollisionPiece("box", position, turn, size))
            continue
        corners = [
            (r * np.cos(azimuth + side), r * np.sin(azimuth + side), height)
            for side in (-half, half)
            for radii in (r_inner, r_outer)
            for r, height in zip(radii, z)
        ]
        pieces.append(hull(np.array(corners)))
    return pieces


def _base(vessel: Vessel, top: float) -> list[CollisionPiece]:
    """What stands on the table: a cylinder where the base is upright, frusta along its fillet elsewhere."""
    z = np.unique(np.concatenate([[0.0], vessel.outer[vessel.outer[:, 1] < top - 1e-5, 1], [top]]))
    outer = np.stack([vessel.outer_radius(z), z], axis=1)
    if np.ptp(outer[:, 0]) < 5e-4:
        return [cylinder(float(outer[:, 0].mean()), 0.0, top)]
    chosen = outer[breakpoints(outer, 8e-4, 2)]
    return [frustum(tuple(low), tuple(high)) for low, high in zip(chosen[:-1], chosen[1:])]


def handle_pieces(handle: Handle, vessel: Vessel) -> list[CollisionPiece]:
    """Capsules along the part of the handle outside the wall. A strap is wider than thick: pairs beside y = 0."""
    clear = handle.centreline[:, 0] > vessel.outer_radius(handle.centreline[:, 1]) - 0.5 * handle.thickness
    points = np.flatnonzero(clear)
    line = handle.centreline[points[0] : points[-1] + 1]
    chosen = breakpoints(line, 5e-4, HANDLE_PIECES)
    pieces = []
    for first, last in zip(chosen[:-1], chosen[1:]):
        part = slice(points[0] + first, points[0] + last + 1)
        radius = float(handle.thickness[part].mean())
        beside = max(float(handle.width[part].mean()) - radius, 0.0)
        for y in (-beside, beside) if beside > 5e-4 else (0.0,):
            pieces.append(_capsule(line[first], line[last], y, radius))
    return pieces


def _capsule(start: np.ndarray, end: np.ndarray, y: float, radius: float) -> CollisionPiece:
    """A capsule between two points (x, z) in the plane at y."""
    step = end - start
    tilt = np.arctan2(step[0], step[1])  # about +y, from +z
    position = np.array([0.5 * (start[0] + end[0]), y, 0.5 * (start[1] + end[1])])
    turn = np.array([np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0])
    return CollisionPiece("capsule", position, turn, (radius, 0.5 * float(np.hypot(*step))))


def stacked_pieces(profile: Curve, section: Section | None, most: int = 7) -> list[CollisionPiece]:
    """A closed body as a stack of cylinders and frusta along the outside of its profile."""
    z = profile[:, 1]
    first, last = int(np.flatnonzero(z <= 1e-9)[-1]), int(np.flatnonzero(z >= z.max() - 1e-9)[0])
    outside = profile[first : last + 1]
    chosen = outside[breakpoints(outside, 7e-4, most)]
    pieces = []
    for low, high in zip(chosen[:-1], chosen[1:]):
        if high[1] - low[1] < 1e-5:
            continue
        if section is None and abs(high[0] - low[0]) < 4e-4:
            pieces.append(cylinder(float(0.5 * (low[0] + high[0])), float(low[1]), float(high[1])))
        else:
            pieces.append(frustum((float(low[0]), float(low[1])), (float(high[0]), float(high[1])), section))
    return pieces
