"""When other resting poses than upright are tried, and when one of them is kept.

Upright is the default: it is given up only where its fit leaves measurements unexplained, or a closed top
shows that a vessel is upside down, and another pose at rest explains them clearly better. Depth decides, not
the score of the acceptance model, which was fitted on upright objects.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from perception.inference.contents import find_rim
from perception.inference.evidence import Evidence
from perception.inference.initialise import plane_basis
from perception.inference.observation import ObjectObservation, measured_points
from perception.inference.resting import rests_stably
from perception.types import Category, ObjectEstimate, SupportPlane

# Misfit of an upright fit from which on other poses are tried: large for mugs and bowls because of handles
# and cavities.
DOUBTFUL: Mapping[Category, float] = {"mug": 0.35, "bowl": 0.2, "bottle": 0.1, "can": 0.1}
CONTRADICTED = 0.45  # misfit that true objects of the class hardly ever have
CLEARLY = 0.6  # largest misfit of another pose relative to that of the upright one
TURNED = 0.9  # the same for upside-down vessels with a closed top
# Largest misfit of another pose, or of an object without a class.
GOOD: Mapping[Category, float] = {"mug": 0.25, "bowl": 0.15, "bottle": 0.15, "can": 0.15}
# Misfit (plus an offset) and systematic deviation, relative to those of a fit the other way round, below
# which the depth tells the ends of a can apart. Set on 114 lying objects, a quarter of training families.
CLOSER_MISFIT, MISFIT_OFFSET, CLOSER_SURFACE = 0.65, 0.005, 0.8
CLOSED = 0.93  # height of the middle of a closed top, in heights of its edge
_INNER = 0.6  # part of the radius that is the middle of the top
_MIN_POINTS = 40


def misfit(evidence: Evidence) -> float:
    """Return the share of the measured pixels that contradict a fit, plus the free space that it violates."""
    return 1 - evidence.explained + evidence.free_space


def is_much_closer(one: Evidence, other: Evidence) -> bool:
    """Return whether a fit explains the depth so much better than another that nothing else counts."""
    explains_more = misfit(one) + MISFIT_OFFSET < CLOSER_MISFIT * (misfit(other) + MISFIT_OFFSET)
    return explains_more and one.systematic < CLOSER_SURFACE * other.systematic


def is_doubtful(evidence: Evidence, category: Category) -> bool:
    """Return whether the evidence of an upright fit is so poor that the object may rest in another pose."""
    return misfit(evidence) > DOUBTFUL[category] or (category == "can" and not evidence.converged)


def is_contradicted(evidence: Evidence) -> bool:
    """Return whether the evidence is so poor that the object is of another class or at rest otherwise."""
    return misfit(evidence) > CONTRADICTED


def has_closed_top(observations: Sequence[ObjectObservation], plane: SupportPlane) -> bool:
    """Return whether the middle of the upper side is as high as its edge: a vessel upside down, or full."""
    points = measured_points(observations)
    plan, height = points @ plane_basis(plane)[:2].T, plane.height_above(points)
    rim = find_rim(plan, height)
    if rim is None:
        return False
    inner = np.linalg.norm(plan - rim.centre, axis=1) < _INNER * rim.radius
    return bool(inner.sum() >= _MIN_POINTS and np.median(height[inner]) > CLOSED * rim.height)


def is_better(
    other: Evidence, estimate: ObjectEstimate, upright: Evidence | None, plane: SupportPlane, closed: bool
) -> bool:
    """Return whether a fit in another pose is at rest and explains the depth clearly better than upright.

    Args:
        other: Evidence of the fit in the other pose.
        estimate: Its estimate.
        upright: Evidence of the upright fit; None if that failed.
        plane: Support plane.
        closed: Whether the object has a closed top.
    """
    if not is_good(other, estimate, plane):
        return False
    ratio = TURNED if closed and estimate.resting == "upside-down" else CLEARLY
    return upright is None or misfit(other) < ratio * misfit(upright)


def is_good(evidence: Evidence, estimate: ObjectEstimate, plane: SupportPlane) -> bool:
    """Return whether a fit is plausible, at rest and explains almost all of the depth."""
    explains = estimate.status != "implausible" and misfit(evidence) < GOOD[estimate.category]
    return explains and rests_stably(estimate.mesh_world, plane)
