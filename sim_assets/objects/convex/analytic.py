"""Convex pieces of the object families, built from the same curves as their surfaces.

Contact is more stable than with decompositions of meshes: a wall is a ring of small convex pieces around an
open cavity, and only the base touches the table (rings start ``CLEARANCE`` above it).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from sim_assets.objects.convex.pieces import (
    CLEARANCE,
    CollisionPiece,
    breakpoints,
    cylinder,
    frustum,
    hull,
)
from sim_assets.objects.profiles import Curve
from sim_assets.objects.solids import Handle, Section
from sim_assets.objects.vessel import RIM_SEGMENTS, Vessel

HANDLE_PIECES = 8


def vessel_pieces(
    vessel: Vessel, around: int, levels: int, section: Section | None = None, tolerance: float = 8e-4
) -> list[CollisionPiece]:
    """Build the base under the floor, and a wall of `around` pieces on each of up to `levels` levels.

    The wall follows inner and outer curve up to the rim's rounding, and keeps its width above.
    With a section other than a circle, pieces meet at azimuth 0 and `around` is a multiple of its corners.
    """
    start = max(vessel.floor, CLEARANCE)
    shoulder = vessel.height - _rim_height(vessel)
    between = vessel.inner[:, 1]
    z = np.concatenate([[start], between[(between > start + 1e-5) & (between < shoulder - 1e-5)], [shoulder]])
    wall = np.stack([vessel.inner_radius(z), vessel.outer_radius(z), z], axis=1)
    wall[-1, 2] = vessel.height
    wall = wall[breakpoints(wall, tolerance, levels)]
    if section is not None:
        pieces = _section_base(vessel, start, section, around)
        for low, high in pairwise(wall):
            pieces += _section_ring(low, high, section, around)
        return pieces
    wall[:, :2] /= np.sqrt(np.cos(np.pi / around))  # chords with equal areas outside and inside the circles
    pieces = _base(vessel, start)
    for low, high in pairwise(wall):
        pieces += _ring(low, high, around)
    return pieces


def _section_ring(low: np.ndarray, high: np.ndarray, section: Section, around: int) -> list[CollisionPiece]:
    """Build hulls around the axis between two levels (inner radius, outer radius, z), edges at azimuth 0."""
    azimuths = 2 * np.pi * np.arange(around + 1) / around
    cos, sin = np.cos(azimuths), np.sin(azimuths)
    corners = []  # (around + 1, 3) each: inner and outer corners of both levels
    for inner, outer, z in (low, high):
        factor = 1.0 + section.weight(np.array([z])) * section.modulation(cos, sin)
        corners += [
            np.stack([r * factor * cos, r * factor * sin, np.full_like(cos, z)], axis=1)
            for r in (inner, outer)
        ]
    return [hull(np.concatenate([ring[k : k + 2] for ring in corners])) for k in range(around)]


def _section_base(vessel: Vessel, top: float, section: Section, around: int) -> list[CollisionPiece]:
    """Build hulls below the floor of a vessel that is not round."""
    outer = _base_outline(vessel, top)
    chosen = outer[breakpoints(outer, 8e-4, 2)]
    return [frustum(tuple(low), tuple(high), section, around, 0.0) for low, high in pairwise(chosen)]


def _rim_height(vessel: Vessel) -> float:
    """Return the height of the rim's rounding [m]."""
    z = vessel.inner[:, 1]
    thickness = vessel.outer_radius(z) - vessel.inner_radius(z)
    full = thickness > 0.85 * thickness[-2 * RIM_SEGMENTS]
    return vessel.height - float(z[np.flatnonzero(full)[-1]])


def _ring(low: np.ndarray, high: np.ndarray, around: int) -> list[CollisionPiece]:
    """Build pieces around the axis from levels (inner radius, outer radius, z): boxes where upright."""
    half = np.pi / around
    azimuths = 2 * np.pi * np.arange(around) / around
    if np.abs(high[:2] - low[:2]).max() < 5e-4:
        face_in, face_out = 0.5 * (low + high)[:2] * np.cos(half)
        middle, z = 0.5 * (face_in + face_out), 0.5 * (low[2] + high[2])
        size = (0.5 * (face_out - face_in), middle * np.tan(half), 0.5 * (high[2] - low[2]))
        return [
            CollisionPiece(
                "box",
                np.array([middle * np.cos(azimuth), middle * np.sin(azimuth), z]),
                np.array([np.cos(azimuth / 2), 0.0, 0.0, np.sin(azimuth / 2)]),
                size,
            )
            for azimuth in azimuths
        ]
    pieces = []
    for azimuth in azimuths:
        corners = [
            (r * np.cos(azimuth + side), r * np.sin(azimuth + side), level[2])
            for side in (-half, half)
            for level in (low, high)
            for r in level[:2]
        ]
        pieces.append(hull(np.array(corners)))
    return pieces


def _base(vessel: Vessel, top: float) -> list[CollisionPiece]:
    """Build the base: a cylinder where its side is vertical, frusta along its fillet."""
    outer = _base_outline(vessel, top)
    if np.ptp(outer[:, 0]) < 5e-4:
        return [cylinder(float(outer[:, 0].mean()), 0.0, top)]
    chosen = outer[breakpoints(outer, 8e-4, 2)]
    return [frustum(tuple(low), tuple(high)) for low, high in pairwise(chosen)]


def _base_outline(vessel: Vessel, top: float) -> Curve:
    """Return the outer curve up to a height."""
    z = np.unique(np.concatenate([[0.0], vessel.outer[vessel.outer[:, 1] < top - 1e-5, 1], [top]]))
    return np.stack([vessel.outer_radius(z), z], axis=1)


def handle_pieces(handle: Handle, vessel: Vessel) -> list[CollisionPiece]:
    """Add capsules along the handle outside the wall, in pairs beside y = 0 where it is wider than thick."""
    clear = handle.centreline[:, 0] > vessel.outer_radius(handle.centreline[:, 1]) - 0.5 * handle.thickness
    points = np.flatnonzero(clear)
    line = handle.centreline[points[0] : points[-1] + 1]
    chosen = breakpoints(line, 5e-4, HANDLE_PIECES)
    pieces = []
    for first, last in pairwise(chosen):
        part = slice(points[0] + first, points[0] + last + 1)
        radius = float(handle.thickness[part].mean())
        beside = max(float(handle.width[part].mean()) - radius, 0.0)
        for y in (-beside, beside) if beside > 5e-4 else (0.0,):
            pieces.append(_capsule(line[first], line[last], y, radius))
    return pieces


def _capsule(start: np.ndarray, end: np.ndarray, y: float, radius: float) -> CollisionPiece:
    """Build a capsule between two points (x, z) in the plane at y."""
    step = end - start
    tilt = np.arctan2(step[0], step[1])  # about +y, from +z
    position = np.array([0.5 * (start[0] + end[0]), y, 0.5 * (start[1] + end[1])])
    turn = np.array([np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0])
    return CollisionPiece("capsule", position, turn, (radius, 0.5 * float(np.hypot(*step))))


def stacked_pieces(profile: Curve, section: Section | None, most: int = 9) -> list[CollisionPiece]:
    """Approximate a closed body by a stack of cylinders and frusta along the outside of its profile."""
    z = profile[:, 1]
    first, last = int(np.flatnonzero(z <= 1e-9)[-1]), int(np.flatnonzero(z >= z.max() - 1e-9)[0])
    outside = profile[first : last + 1]
    chosen = outside[breakpoints(outside, 7e-4, most)]
    pieces = []
    for low, high in pairwise(chosen):
        if high[1] - low[1] < 1e-5:
            continue
        if section is None and abs(high[0] - low[0]) < 4e-4:
            pieces.append(cylinder(float(0.5 * (low[0] + high[0])), float(low[1]), float(high[1])))
        else:
            pieces.append(frustum((float(low[0]), float(low[1])), (float(high[0]), float(high[1])), section))
    return pieces
