"""Grasp candidates by class, measured on the reconstructed mesh.

Hollow objects (mugs, bowls, open tumblers) are held by the rim with one finger inside, the hand tilted to the
slope of the wall where the pads touch. Cans and bottles are held from above around body, neck or cap, where
the section fits between the fingers and changes little over the height of the pads.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from manipulation.cross_sections import SectionCache
from manipulation.grasp_config import GraspConfig
from manipulation.rim_grasps import rim_grasps
from manipulation.top_grasps import top_grasps
from manipulation.types import Grasp, StandingObject
from perception.mesh_sections import radial_hits


@dataclass(frozen=True)
class GraspSet:
    """Candidates, best first, and why the others were dropped (reason: count)."""

    grasps: tuple[Grasp, ...]
    rejected: Counter[str]

    @property
    def n_tried(self) -> int:
        return len(self.grasps) + sum(self.rejected.values())

    def why_none(self, name: str) -> str:
        """One line for an object without a grasp: counts and a remedy."""
        counts = ", ".join(f"{count} {reason}" for reason, count in self.rejected.most_common(4))
        return f"No grasp for {name}: of {self.n_tried} tried, {counts}; leave it out or use a wider gripper"


def grasp_candidates(item: StandingObject, config: GraspConfig | None = None) -> GraspSet:
    """Return all grasps the object's class and shape offer, best first."""
    config = config or GraspConfig()
    rejected: Counter[str] = Counter()
    sections = SectionCache(item.vertices, item.faces)
    if item.category in ("mug", "bowl"):
        grasps = rim_grasps(item, sections, config, rejected)
    else:
        grasps = top_grasps(item, sections, config, rejected)
        if not grasps and _is_open(item, sections):
            grasps = rim_grasps(item, sections, config, rejected)
    return GraspSet(tuple(sorted(grasps, key=lambda grasp: -grasp.score)), rejected)


def _is_open(item: StandingObject, sections: SectionCache) -> bool:
    """Whether the object has a wide cavity below its top, such as a tumbler."""
    hits = radial_hits(sections.at(item.top - 0.012), np.zeros(2), 0.1)
    return len(hits) >= 2 and bool(hits[0] > 0.02)
