"""Nesting of bowls from the radial profiles of their reconstructed meshes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from manipulation.cross_sections import CrossSectionCache
from manipulation.types import StandingObject
from perception.mesh_sections import radial_hits

_STEP = 0.002  # [m] between heights of a profile
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


def resting_height(upper: RadialProfile, lower: RadialProfile, clearance: float = 0.0005) -> float | None:
    """Return the height [m] of the upper bowl's base above the lower one's; None if it does not fit inside.

    This is the smallest lift d, in steps of 1 mm, with outer_upper(z - d) + clearance <= inner_lower(z) at
    every height z up to the lower rim.
    """
    for lift in np.arange(0.0, lower.rim, 0.001):
        z = upper.heights + lift
        inside = z <= lower.rim
        cavity = np.interp(z[inside], lower.heights, lower.inner, left=0.0)
        if np.all(upper.outer[inside] + clearance <= cavity):
            return float(lift)
    return None


def nests(upper: RadialProfile, lower: RadialProfile) -> float | None:
    """Return the resting height [m] if it is at most 70 % of the lower bowl's height, else None."""
    lift = resting_height(upper, lower)
    return lift if lift is not None and lift <= _MAX_RELATIVE_LIFT * lower.rim else None


def stack_bowls(bowls: Sequence[StandingObject]) -> list[list[StandingObject]]:
    """Return stacks of nesting bowls, each from the largest up, built greedily from the largest bowl."""
    stacks: list[list[StandingObject]] = []
    profiles = {bowl.name: radial_profile(bowl) for bowl in bowls}
    for bowl in sorted(bowls, key=lambda b: -float(profiles[b.name].outer.max())):
        for stack in stacks:
            if nests(profiles[bowl.name], profiles[stack[-1].name]) is not None:
                stack.append(bowl)
                break
        else:
            stacks.append([bowl])
    return stacks


def nest_heights(stack: Sequence[StandingObject]) -> list[float]:
    """Return the height [m] of each bowl's base above the lowest one's, for a stack from the lowest up.

    A bowl that does not nest rests on the rim of the one below.
    """
    profiles = [radial_profile(bowl) for bowl in stack]
    heights = [0.0]
    for lower, upper in itertools.pairwise(profiles):
        lift = nests(upper, lower)
        heights.append(heights[-1] + (lower.rim if lift is None else lift))
    return heights
