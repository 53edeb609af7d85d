"""Collision geometry of bowls and mugs with something in them: convex pieces of wall around an open cavity.

The one convex hull that represents an empty vessel would contain the object inside it, and the fingers that
grasp that object.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from manipulation.cross_sections import CrossSectionCache
from manipulation.grasp_config import GraspConfig
from manipulation.hulls import convex_pieces, reduced_hull
from manipulation.lying_grasps import lies
from manipulation.rim_grasps import wall_at
from manipulation.standing import split_handle
from manipulation.types import StandingObject

Vertices = Float[np.ndarray, "_k 3"]
Pose = Float[np.ndarray, "4 4"]

_RAISED = 0.006  # [m], smallest height of what a vessel holds above the vessel's base
_SECTORS = 16  # of the wall
_LEVELS = 4  # heights between which the wall is divided
_STEP = 0.004  # [m], between the heights at which the floor of the cavity is searched for
_RIM = 0.002  # [m], distance of the highest cross-section from the rim, which is rounded
_UNEVEN = 0.012  # [m], largest distance between the highest and the lowest place of a rim
_HOLLOW = 0.75  # smallest fraction of a cross-section's azimuths with a wall


def holds(vessel: StandingObject, T_world_stand: Pose, others: Iterable[tuple[StandingObject, Pose]]) -> bool:
    """Return whether the lowest point of another object is in the cavity of an upright bowl or mug.

    Args:
        vessel: the object.
        T_world_stand: pose of its stand frame.
        others: the other objects with the poses of their stand frames.
    """
    if vessel.category not in ("bowl", "mug") or lies(T_world_stand):
        return False
    radius = 0.5 * float(np.ptp(vessel.vertices[:, 1]))
    for other, T in others:
        points = (other.vertices @ T[:3, :3].T + T[:3, 3] - T_world_stand[:3, 3]) @ T_world_stand[:3, :3]
        lowest = points[np.argmin(points[:, 2])]
        if _RAISED < lowest[2] < vessel.top - _RAISED and np.hypot(lowest[0], lowest[1]) < radius:
            return True
    return False


def vessel_pieces(vessel: StandingObject, config: GraspConfig = GraspConfig()) -> tuple[Vertices, ...]:
    """Return the convex pieces of a vessel in its stand frame: wall, floor, and handle of a mug.

    The wall is divided into sectors. Each piece encloses its part of the wall; the chords of the inner side
    make the cavity up to 2 % narrower. A mesh without a cavity is represented by its convex hull.
    """
    sections = CrossSectionCache(vessel.vertices, vessel.faces)
    rings = _rings(sections, vessel.top, config)
    if rings is None:
        return convex_pieces(vessel)
    body, *handle = split_handle(vessel.vertices, vessel.category)
    floor = float(rings[0, 0, 0, 2])
    base = body[body[:, 2] <= floor + 1e-9]
    if len(base) < 4 or np.ptp(base[:, 2]) < 1e-4:
        return convex_pieces(vessel)
    pieces = [reduced_hull(np.concatenate([base, rings[0].reshape(-1, 3)]))]
    for lower, upper in itertools.pairwise(rings):
        for k in range(_SECTORS):
            sector = (k, (k + 1) % _SECTORS)
            pieces.append(reduced_hull(np.concatenate([lower[sector, :], upper[sector, :]]).reshape(-1, 3)))
    return (*pieces, *(reduced_hull(part) for part in handle))


def _rings(
    sections: CrossSectionCache, top: float, config: GraspConfig
) -> Float[np.ndarray, "levels sectors 2 3"] | None:
    """Return points on the inner and outer sides of the wall, from the floor of the cavity to the rim [m].

    None where the mesh has no cavity.
    """
    # Half a sector away from +x: nowhere through the handle of a mug.
    azimuths = 2 * np.pi * (np.arange(_SECTORS) + 0.5) / _SECTORS
    hollow: dict[float, np.ndarray] = {}
    for z in np.arange(top - _RIM, 0.0, -_STEP):
        radii = _radii(sections, float(z), azimuths, config)
        if radii is None:
            if hollow or z < top - _UNEVEN:
                break
            continue
        hollow[float(z)] = radii
    if len(hollow) < _LEVELS:
        return None
    known = sorted(hollow)
    heights = [known[round(i)] for i in np.linspace(0, len(known) - 1, _LEVELS)]
    circumscribed = np.array([1.0, 1 / np.cos(np.pi / _SECTORS)])  # the outer side's chords enclose its arcs
    rings = []
    for z in heights:
        radii = hollow[z] * circumscribed
        height = np.full_like(radii, top if z == heights[-1] else z)
        across = radii * np.cos(azimuths)[:, None], radii * np.sin(azimuths)[:, None]
        rings.append(np.stack([*across, height], axis=-1))
    return np.stack(rings)


def _radii(
    sections: CrossSectionCache, z: float, azimuths: Float[np.ndarray, "_n"], config: GraspConfig
) -> Float[np.ndarray, "_n 2"] | None:
    """Return distances [m] of the wall's inner and outer sides from the axis; None below the cavity."""
    walls = [wall_at(sections, z, float(azimuth), config) for azimuth in azimuths]
    found = np.array(
        [(wall.inner, wall.outer) if wall is not None and wall.hollow else (np.nan, np.nan) for wall in walls]
    )
    gaps = np.isnan(found[:, 0])
    if gaps.mean() > 1 - _HOLLOW:
        return None
    found[gaps] = np.median(found[~gaps], axis=0)
    return found
