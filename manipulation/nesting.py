"""Nesting of bowls: which sits in which, and how high, from their reconstructed meshes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float

from manipulation.cross_sections import CrossSectionCache
from manipulation.types import StandingObject
from perception.mesh_sections import radial_hits

_STEP = 0.002  # [m] between heights of a profile
_RADIUS_STEP = 0.001  # [m] of surfaces
_PLANES = np.pi * np.arange(16) / 16 + 0.05  # azimuths [rad] of vertical planes, each with two sides
_MAX_RELATIVE_LIFT = 0.7  # of a nested bowl's base, relative to the height of the lower bowl
_AZIMUTHS = 2 * np.pi * np.arange(8) / 8 + 0.05  # offset from round angles, where meshes often have edges


@dataclass(frozen=True)
class RadialProfile:
    """Inner and outer radii of an upright object of revolution over height.

    Attributes:
        heights: (k,) heights above its support in [m].
        outer: (k,) outer radius in [m].
        inner: (k,) radius of the cavity in [m]; 0 where there is none.
    """

    heights: Float[np.ndarray, "k"]
    outer: Float[np.ndarray, "k"]
    inner: Float[np.ndarray, "k"]

    @property
    def rim(self) -> float:
        """Height of the rim in [m]."""
        return float(self.heights[-1])


def radial_profile(item: StandingObject) -> RadialProfile:
    """Return the radii of an object, each the median over eight directions."""
    sections = CrossSectionCache(item.vertices, item.faces)
    low, high = item.vertices[:, 2].min(), item.vertices[:, 2].max()
    heights = np.arange(max(low, 0.0) + 0.001, high - 0.0005, _STEP)
    outer, inner = np.zeros(len(heights)), np.zeros(len(heights))
    for index, z in enumerate(heights):
        hits = [radial_hits(sections.at(z), np.zeros(2), azimuth) for azimuth in _AZIMUTHS]
        # Even numbers of crossings mean that the axis is in the cavity, outside the material.
        outer[index] = np.median([h[-1] if len(h) else 0.0 for h in hits])
        inner[index] = np.median([h[0] if len(h) >= 2 and len(h) % 2 == 0 else 0.0 for h in hits])
    # A reconstructed rim is uneven: cross-sections at its top miss the wall in half of the directions.
    open_rows = np.flatnonzero(inner)
    rows = slice(int(open_rows[-1]) + 1) if len(open_rows) else slice(None)
    return RadialProfile(heights[rows], outer[rows], inner[rows])


@dataclass(frozen=True)
class RadialSurfaces:
    """Topmost and lowest surface of an upright object about its axis, at radii in steps of 1 mm.

    Attributes:
        top: (k,) largest height over all azimuths of the topmost surface in [m]; -inf where there is none.
        bottom: (k,) least height of the lowest surface in [m]; inf where there is none.
    """

    top: Float[np.ndarray, "k"]
    bottom: Float[np.ndarray, "k"]


def radial_surfaces(item: StandingObject) -> RadialSurfaces:
    """Return the surfaces of an object from sections with vertical planes through its axis."""
    mesh = trimesh.Trimesh(item.vertices, item.faces, process=False)
    radii = np.arange(0.0, np.linalg.norm(item.vertices[:, :2], axis=1).max() + _RADIUS_STEP, _RADIUS_STEP)
    top, bottom = np.full(len(radii), -np.inf), np.full(len(radii), np.inf)
    for azimuth in _PLANES:
        outward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        normal = np.array([-outward[1], outward[0], 0.0])
        segments = np.reshape(trimesh.intersections.mesh_plane(mesh, normal, np.zeros(3)), (-1, 2, 3))
        (r0, r1), (z0, z1) = (segments @ outward).T, segments[..., 2].T
        for side in (radii, -radii):
            share = (side[:, None] - r0) / np.where(r1 == r0, np.inf, r1 - r0)
            crosses = (np.minimum(r0, r1) <= side[:, None]) & (side[:, None] <= np.maximum(r0, r1))
            z = z0 + share * (z1 - z0)
            top = np.maximum(top, np.where(crosses, z, -np.inf).max(axis=1, initial=-np.inf))
            bottom = np.minimum(bottom, np.where(crosses, z, np.inf).min(axis=1, initial=np.inf))
    return RadialSurfaces(top, bottom)


def resting_lift(upper: RadialSurfaces, lower: RadialSurfaces) -> float:
    """Return the height [m] of the upper base above the lower one at the first contact, at any yaw.

    The upper object is lowered along the common axis: d = max over r of top_lower(r) - bottom_upper(r).
    """
    shared = min(len(upper.bottom), len(lower.top))
    return float((lower.top[:shared] - upper.bottom[:shared]).max())


def nests(upper: RadialSurfaces, lower: RadialSurfaces) -> float | None:
    """Return the resting height [m] if it is at most 70 % of the lower bowl's height, else None."""
    lift = resting_lift(upper, lower)
    return lift if lift <= _MAX_RELATIVE_LIFT * lower.top.max() else None


def stack_bowls(bowls: Sequence[StandingObject]) -> list[list[StandingObject]]:
    """Return stacks of nesting bowls, each from the largest up, built greedily from the largest bowl."""
    stacks: list[list[StandingObject]] = []
    of = {bowl.name: radial_surfaces(bowl) for bowl in bowls}
    for bowl in sorted(bowls, key=lambda b: -len(of[b.name].top)):
        for stack in stacks:
            if nests(of[bowl.name], of[stack[-1].name]) is not None:
                stack.append(bowl)
                break
        else:
            stacks.append([bowl])
    return stacks


def nest_heights(stack: Sequence[StandingObject]) -> list[float]:
    """Return the height [m] of each bowl's base above the lowest one's, for a stack from the lowest up."""
    lifts = [resting_lift(upper, lower) for lower, upper in itertools.pairwise(map(radial_surfaces, stack))]
    return [0.0, *map(float, np.cumsum(lifts))]
