"""Grasp candidates from the category and the reconstructed mesh of an object.

Hollow objects (mugs, bowls, open tumblers) are grasped at the rim with one finger inside, the hand tilted to
the slope of the wall at the pads. Cans and bottles are grasped from above around body, neck or cap, where
the cross-section fits between the fingers and is nearly constant over the height of the pads. Without such a
place, as on a bottle that tapers all the way up, the hand may be at any angle.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from manipulation.antipodal_grasps import antipodal_grasps
from manipulation.cross_sections import CrossSectionCache
from manipulation.grasp_config import GraspConfig, on_hand
from manipulation.rim_grasps import rim_grasps
from manipulation.top_grasps import top_grasps
from manipulation.types import RIMMED, GraspSet, StandingObject
from manipulation.uncertainty import ranked
from perception.mesh_sections import radial_hits

_UP = np.array([0.0, 0.0, 1.0])


def grasp_candidates(item: StandingObject, config: GraspConfig = GraspConfig()) -> GraspSet:
    """Return all grasps for the object's category and shape, in descending order of score.

    Grasps at uncertain surfaces come later. What nothing holds from above has antipodal grasps, if the hand
    can be tilted.

    Args:
        item: Object with its mesh in the stand frame, in metres.
        config: Settings of grasp generation.
    """
    found = grasps_from_above(item, config)
    if found.grasps or config.max_tilt == 0:
        return found
    between = antipodal_grasps(item, (_UP,), config)
    return replace(found, grasps=ranked(item, between.grasps, config.gripper))


def grasps_from_above(item: StandingObject, config: GraspConfig = GraspConfig()) -> GraspSet:
    """Return the grasps at the rim, or around body, neck or cap, in descending order of score.

    Args:
        item: Object with its mesh in the stand frame, in metres.
        config: Settings of grasp generation.
    """
    rejected: Counter[str] = Counter()
    sections = CrossSectionCache(item.vertices, item.faces)
    if item.category in RIMMED:
        grasps = rim_grasps(item, sections, config, rejected)
    else:
        grasps = top_grasps(item, sections, config, rejected)
        if not grasps and _is_open(item, sections):
            grasps = rim_grasps(item, sections, config, rejected)
    ordered = tuple(sorted(grasps, key=lambda grasp: -grasp.score))
    found = on_hand(GraspSet(ordered, rejected), config.gripper)
    return replace(found, grasps=ranked(item, found.grasps, config.gripper))


def _is_open(item: StandingObject, sections: CrossSectionCache) -> bool:
    """Return whether the object has a wide cavity below its top, as a tumbler has."""
    hits = radial_hits(sections.at(item.top - 0.012), np.zeros(2), 0.1)
    return len(hits) >= 2 and bool(hits[0] > 0.02)
