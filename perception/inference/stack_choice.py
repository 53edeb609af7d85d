"""Whether the fits of two parts replace that of the whole: stacks, and single objects that look like one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from perception.inference.contents import VESSELS
from perception.inference.explanation import shared_volume, unexplained
from perception.types import ObjectEstimate, SupportPlane

DOUBTFUL = 0.04  # share of unexplained points from which on an object may be several
CLEARLY = 0.5  # largest share of them that the parts leave unexplained, relative to the whole
MOST_UNEXPLAINED = 0.1  # by the parts
BEYOND_DOUBT, BEYOND_DOUBT_SCORE = 0.15, 0.1  # share of them, and scores that suffice then
WEAK, FAR_BETTER = 0.5, 0.3  # score below which an object may be several, and by how much theirs are higher
WEAK_BOTTLE = 0.9  # the same of an upright bottle
MIN_SCORES = (0.2, 0.5)  # of the fits of the lower part, whose upper side is hidden, and of the upper one
# The same of what has no class: foot and shade of a lamp had 0.45 and 0.6.
UNNAMED_SCORES = (0.5, 0.65)
BESIDE_SCORE = 0.5  # least score of two parts beside each other: neither hides the other
LIKELY_WHOLE = 0.8  # score from which on a can or a bottle is likely one, and its parts have that least score
ALIKE_SCORE = 0.5  # least score of two parts of the same colours, which are seldom two objects
SHARED = 0.15  # share of a part's volume in the other one from which on they are no two objects
# Least scores of the fits of two vessels that look like one; height [m] of the upper one's base, and share of
# that of its rim: mugs have thinner floors.
SURE_SCORE, THICK, THICK_SHARE = 0.8, 0.03, 0.35
# Of a mug in a bowl that looks like a mug: least score of the fit of the bowl, by how much that of the mug is
# higher than that of both as one mug, ratio of the radii, and height [m] of the mug's base.
SHALLOW_SCORE, MUCH_BETTER, BROADER, FLOOR = 0.7, 0.05, 1.05, 0.01
# Least score of the fit of a bowl that is hardly broader, and share of unexplained points above which both
# can explain more.
NARROW_SCORE, NARROW_DOUBT = 0.35, 0.01
FULLY = 0.005  # share of unexplained points up to which a bottle explains all that is seen
# Radius of the upper of two cans relative to the lower one where they meet, from which on they are no bottle.
WIDER = 1.1
NEAR_END = (0.1, 0.35)  # shares of the height between which that radius is measured
COAXIAL = 0.005  # [m] between the axes of two cans that are one bottle
# [m] between two parts, one above the other, from which on neither carries the other: a wide bowl hides the
# uppermost part of the can below it.
GAP = 0.03
LEAST_HEIGHT = 0.025  # [m] of a part; flatter ones are the thick floor of a bowl
TALL = 1.3  # height of a bowl in radii, from which on it is none
SLENDER = 1.5  # least height of a bottle, in diameters


def is_doubtful(whole: ObjectEstimate | None, before: float) -> bool:
    """Return whether an instance may be several, by its estimate and the share that it leaves unexplained."""
    return before > DOUBTFUL or (whole is not None and _may_be_two(whole))


def has_unlikely_shape(estimate: ObjectEstimate) -> bool:
    """Return whether a shape is far from its class: a bowl on something becomes one on a high foot."""
    is_tall_bowl = estimate.category == "bowl" and estimate.height > TALL * estimate.radius
    return estimate.status == "implausible" or (is_tall_bowl and estimate.resting == "upright")


def are_two(
    pair: Sequence[ObjectEstimate],
    whole: ObjectEstimate | None,
    points: Float[np.ndarray, "n 3"],
    before: float,
    plane: SupportPlane,
    is_left_out: bool = False,
) -> bool:
    """Return whether two fits replace the whole.

    Args:
        pair: Fits of the lower and of the upper part.
        whole: Estimate of both as a single object; None if it was rejected.
        points: Their measured points in the world frame, in metres.
        before: Share of the points that the whole leaves unexplained.
        plane: Support plane.
        is_left_out: Whether the whole is taken for a thing of no class: parts that would be accepted of such
            a thing need not explain more.
    """
    if is_left_out and _is_better(pair, None, points, 1.0):
        return True
    if whole is None or is_doubtful(whole, before):
        return _is_better(pair, whole, points, before)
    after = unexplained(points, pair)
    if after >= DOUBTFUL or not all(is_vessel(e) for e in (*pair, whole)):
        return False
    explains_more = before > NARROW_DOUBT and after < CLEARLY * before
    return _is_raised(pair, whole, plane) or _is_mug_in_bowl(pair, whole, plane, explains_more)


def is_vessel(estimate: ObjectEstimate) -> bool:
    """Return whether an estimate is an upright mug or bowl."""
    return estimate.category in VESSELS and estimate.resting == "upright"


def _is_raised(pair: Sequence[ObjectEstimate], whole: ObjectEstimate, plane: SupportPlane) -> bool:
    """Return whether a vessel that explains what is measured is two, the upper one raised by the lower one.

    A bowl in a mug looks like a mug with a thick floor. The inside of a mug of two colours reaches down to
    the plane.
    """
    base, top = (f(plane.height_above(pair[1].mesh_world.vertices)) for f in (np.min, np.max))
    return min(e.score for e in (*pair, whole)) >= SURE_SCORE and bool(base > max(THICK, THICK_SHARE * top))


def _is_mug_in_bowl(
    pair: Sequence[ObjectEstimate], whole: ObjectEstimate, plane: SupportPlane, explains_more: bool
) -> bool:
    """Return whether a mug that explains what is measured is one in a shallow bowl, which is broader.

    A mug of two colours is as likely as one. Of a bowl that is hardly broader little is seen: its score may
    be lower, and that of the mug as high as that of both as one, if they explain more than that does.
    """
    lower, upper = pair
    base = float(plane.height_above(upper.mesh_world.vertices).min())
    is_likelier = lower.score >= SHALLOW_SCORE and upper.score >= whole.score + MUCH_BETTER
    is_likelier |= explains_more and lower.score >= NARROW_SCORE and upper.score >= whole.score
    is_broader = lower.radius > BROADER * upper.radius and base > FLOOR
    return (lower.category, upper.category) == ("bowl", "mug") and is_likelier and is_broader


def _may_be_two(whole: ObjectEstimate) -> bool:
    """Return whether an object that explains what is measured may be several: two cans look like a bottle."""
    is_bottle = (whole.category, whole.resting) == ("bottle", "upright")
    return whole.score < (WEAK_BOTTLE if is_bottle else WEAK) or has_unlikely_shape(whole)


def _is_likely_one(whole: ObjectEstimate) -> bool:
    """Return whether an object is likely no stack: a closed one with a high score, which holds nothing."""
    is_closed = whole.category not in VESSELS and whole.status != "implausible"
    return is_closed and whole.score >= LIKELY_WHOLE


def are_one(pair: Sequence[ObjectEstimate], whole: ObjectEstimate, before: float) -> bool:
    """Return whether two accepted cans, the upper one not the wider where they meet, are one upright bottle.

    It leaves nothing unexplained. A can that tapers is named a bottle as well.
    """
    if before > FULLY or (whole.category, whole.resting) != ("bottle", "upright"):
        return False
    if any(e.category != "can" for e in pair):
        return False
    lower, upper = (_radius_near(e, end) for e, end in zip(pair, (1.0, 0.0), strict=True))
    if upper > WIDER * lower:
        return False
    apart = np.linalg.norm((pair[0].T_world_object - pair[1].T_world_object)[:2, 3])
    return bool(apart < COAXIAL) and all(e.score >= p for e, p in zip(pair, MIN_SCORES, strict=True))


def _radius_near(estimate: ObjectEstimate, end: float) -> float:
    """Return the radius of an upright object near its base (0) or top (1), beside the rounded edge [m]."""
    z = estimate.mesh.vertices[:, 2]
    share = np.abs((z - z.min()) / np.ptp(z) - end)
    near = estimate.mesh.vertices[(share > NEAR_END[0]) & (share < NEAR_END[1]), :2]
    middle = (estimate.mesh.vertices[:, :2].min(axis=0) + estimate.mesh.vertices[:, :2].max(axis=0)) / 2
    return float(np.median(np.linalg.norm(near - middle, axis=1))) if len(near) else estimate.radius


def are_likely(pair: Sequence[ObjectEstimate]) -> bool:
    """Return whether two accepted parts are objects even if their colours are the same."""
    return all(e.score >= ALIKE_SCORE for e in pair)


def gap_between(lower: ObjectEstimate, upper: ObjectEstimate, plane: SupportPlane) -> float:
    """Return the height of the upper part's base above the top of the lower one [m]; negative inside it."""
    base = (upper.mesh_world.vertices @ plane.normal).min()
    return float(base - (lower.mesh_world.vertices @ plane.normal).max())


def _is_knob(estimate: ObjectEstimate) -> bool:
    """Return whether a part is a bottle hardly taller than wide: the upper half of a teapot is none."""
    return estimate.category == "bottle" and estimate.height < SLENDER * 2 * estimate.radius


def _is_better(
    pair: Sequence[ObjectEstimate],
    whole: ObjectEstimate | None,
    points: Float[np.ndarray, "n 3"],
    before: float,
) -> bool:
    """Return whether two fits are accepted and explain clearly more than the whole did.

    Or as much, with far better scores: a large bowl on a mug is a bowl on a foot, but an unusual one. Those
    of two cans need only be better than that of a bottle. The floor of a shallow bowl may be thicker than
    that of its shape.
    """
    after = unexplained(points, pair)
    is_poor = whole is None or before > DOUBTFUL or whole.score < WEAK
    if any(e.status == "implausible" or e.height < LEAST_HEIGHT or _is_knob(e) for e in pair):
        return False
    if pair[0].resting == "lying":  # nothing stands on what can roll
        return False
    if max(shared_volume(pair[0], pair[1]), shared_volume(pair[1], pair[0])) > SHARED:
        return False
    least = (BEYOND_DOUBT_SCORE,) * 2 if after < BEYOND_DOUBT * before else MIN_SCORES
    if whole is None:
        least = UNNAMED_SCORES
    if pair[1].rests_on != pair[0].id or (whole is not None and _is_likely_one(whole)):
        least = (BESIDE_SCORE,) * 2
    accepted = all(e.score >= p for e, p in zip(pair, least, strict=True))
    if is_poor and accepted and after < min(CLEARLY * before, MOST_UNEXPLAINED):
        return True
    if whole is None or not _may_be_two(whole):
        return False
    are_cans = whole.category == "bottle" and all(e.category == "can" for e in pair)
    are_far_better = min(e.score for e in pair) > whole.score + (0.0 if are_cans else FAR_BETTER)
    if not are_far_better and not (accepted and has_unlikely_shape(whole)):
        return False
    return after < DOUBTFUL or (is_vessel(pair[1]) and unexplained(points, pair, pair[1]) < DOUBTFUL)
