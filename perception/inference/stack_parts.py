"""Objects of stacks that were segmented as one thing: proposed at seams, named by the networks, fitted.

Things that no shape explains, or whose shape leaves measured points unexplained, may be several objects.
They are cut at the seams of their outline. The networks name the parts, the upper one as if its support were
at the seam; both are fitted, the upper one resting on the lower one. The parts replace the whole if both are
accepted and together explain clearly more of the measured points.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from perception.depth_cleaning import clean_frame
from perception.detection.completion import PoseNamer
from perception.detection.geometry import points_of
from perception.detection.instances import remove_specks
from perception.inference.color_cuts import color_cut
from perception.inference.contents import VESSELS
from perception.inference.explanation import FAR, SAMPLES, unexplained
from perception.inference.observation import ObjectObservation
from perception.inference.pose_score import class_mass
from perception.inference.seams import Seam, find_seams, part_masks
from perception.inference.stack_choice import GAP, are_one, are_two, gap_between, is_doubtful, is_vessel
from perception.inference.stacking import raised
from perception.metrics import SurfaceSamples
from perception.types import (
    CATEGORIES,
    OTHER,
    Category,
    ObjectDetection,
    ObjectEstimate,
    RgbdFrame,
    SupportPlane,
    is_unclassified,
    unclassified,
)

Rows = Sequence[Sequence[ObjectDetection]]
Named = Mapping[int, ObjectDetection]  # detections of one part, by the numbers of the frames
Fit = Callable[[Rows, Mapping[int, int]], Sequence[ObjectEstimate]]

SURE = 0.7  # least probability of the networks' names of two vessels that look like one
MIN_CLASS = 0.3  # least mean class probability of a part
BOTH_NAMED = 0.3  # least probability of the names of two parts of different colour: things have two as well
CLEARLY_NAMED = 0.9  # least probability of the name of the upper one if the lower one has no name
CARRIERS: tuple[Category, ...] = ("mug", "bowl", "can")  # nothing stands on a bottle
MIN_PIXELS = 150  # of a part in a view
NAMING_VIEWS = 3
TRIALS = 2  # cuts of one stack whose parts are fitted, besides that between two colours, which comes first
_SPECK = 0.05  # smallest separate piece of a mask, as a share of its largest
_POINTS = 4000


@dataclass(frozen=True)
class Parts:
    """A stack cut at a seam.

    Attributes:
        rows: Detections of the lower and of the upper object in each frame, by their ids.
        ids: Ids of the lower and of the upper object.
    """

    rows: Rows
    ids: tuple[int, int]

    @staticmethod
    def of(count: int, below: Named, above: Named, free_id: int, support: int) -> Parts:
        """Return the parts, detected in some of ``count`` frames, the lower one with the first free id."""
        rows: list[list[ObjectDetection]] = [[] for _ in range(count)]
        for id, named in enumerate((below, above), start=free_id):
            for k, d in named.items():
                rows[k].append(replace(d, instance_id=id, support=support))
        return Parts(rows, (free_id, free_id + 1))

    @property
    def probability(self) -> float:
        """Probability that both parts are of the classes that the networks name."""
        score_of = {d.instance_id: d.score for row in self.rows for d in row}
        return score_of[self.ids[0]] * score_of[self.ids[1]]

    @property
    def categories(self) -> tuple[Category, Category]:
        """Classes of the lower and of the upper part."""
        class_of: dict[int | None, Category] = {d.instance_id: d.category for row in self.rows for d in row}
        return class_of[self.ids[0]], class_of[self.ids[1]]


def split_stacks(
    frames: Sequence[RgbdFrame],
    rows: Rows,
    estimates: Mapping[int, ObjectEstimate],
    planes: Sequence[SupportPlane],
    completer: PoseNamer,
    fit: Fit,
    workers: int | None = None,
) -> dict[int, tuple[ObjectEstimate, ...]]:
    """Return the lower and the upper object of each instance that is a stack, by the instance's id.

    Two cans with one axis that a bottle explains completely are that bottle, with their score.

    Args:
        frames: Views with camera poses.
        rows: Associated detections of each frame, those of no class included.
        estimates: Estimates of instances as single objects, by id; rejected ones are missing.
        planes: Support planes, numbered by ``ObjectDetection.support``.
        completer: Names the parts.
        fit: Reconstructs instances, given which rests on which; detections without an id only occlude others.
        workers: Number of instances cut at a time; None for the number of cores.
    """
    views = [clean_frame(frame) for frame in frames]
    ids = sorted({d.instance_id for row in rows for d in row if d.instance_id is not None})
    free = 1 + max(ids, default=-1)

    def cuts(number: int) -> tuple[list[Parts], Float[np.ndarray, "n 3"], float]:
        id, free_id = ids[number], free + 2 * number
        points, whole = instance_points(views, rows, id), estimates.get(id)
        before = unexplained(points, [] if whole is None else [whole])
        return _cuts(views, rows, id, whole, before, planes, completer, free_id), points, before

    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        open_ = {id: found for id, found in zip(ids, pool.map(cuts, range(len(ids)))) if found[0]}
    found: dict[int, tuple[ObjectEstimate, ...]] = {}
    for trial in range(1 + TRIALS):
        parts = {i: p[trial] for i, (p, *_) in open_.items() if trial < len(p) and i not in found}
        if not parts:
            break
        above = {part.ids[1]: part.ids[0] for part in parts.values()}
        fitted = {e.id: e for e in fit(_with_parts(rows, parts), above)}
        for id, part in parts.items():
            pair, whole = [fitted[k] for k in part.ids if k in fitted], estimates.get(id)
            if len(pair) < 2 or gap_between(pair[0], pair[1], planes[0]) > GAP:
                continue
            if whole is not None and are_one(pair, whole, open_[id][2]):
                found[id] = (replace(whole, score=max(whole.score, min(e.score for e in pair))),)
            elif are_two(pair, whole, *open_[id][1:], planes[0]):
                found[id] = tuple(pair)
    return found


def _cuts(
    views: Sequence[RgbdFrame],
    rows: Rows,
    id: int,
    whole: ObjectEstimate | None,
    before: float,
    planes: Sequence[SupportPlane],
    completer: PoseNamer,
    free_id: int,
) -> list[Parts]:
    """Return ways to cut an instance that are tried, as in ``propose_parts``.

    Args:
        views, rows, id, planes, completer, free_id: As there.
        whole: Estimate of the instance as a single object.
        before: Share of its points which that leaves unexplained.
    """
    if is_doubtful(whole, before):
        by_shape = [
            *parts_inside(views, rows, whole, id, planes, completer, free_id),
            *propose_parts(views, rows, id, planes, completer, free_id),
        ]
        likeliest = sorted(by_shape, key=lambda parts: -parts.probability)[:TRIALS]
        parted = parts_of_two_colors(views, rows, id, planes, completer, free_id, whole is not None)
        return [*parted, *likeliest]
    if whole is not None and is_vessel(whole):
        parted = parts_of_two_colors(views, rows, id, planes, completer, free_id)
        return [p for p in parted if p.probability >= SURE and set(p.categories) <= set(VESSELS)]
    return []


def propose_parts(
    views: Sequence[RgbdFrame],
    rows: Rows,
    id: int,
    planes: Sequence[SupportPlane],
    completer: PoseNamer,
    free_id: int,
) -> list[Parts]:
    """Return ways to cut an instance in two parts of known classes, that at the strongest seam first.

    Args:
        views: Images without flying pixels.
        rows: Associated detections of each frame.
        id: Id of the instance.
        planes: Support planes, numbered by ``ObjectDetection.support``.
        completer: Names the parts.
        free_id: Id of the lower part; that of the upper one follows.
    """
    shown = {k: d for k, row in enumerate(rows) for d in row if d.instance_id == id}
    support = next(iter(shown.values())).support
    seen = {k: ObjectObservation(views[k], d.mask) for k, d in shown.items()}
    proposals = []
    for seam in find_seams(tuple(seen.values()), planes[support]):
        masks = {k: part_masks(view, seam, planes[support]) for k, view in seen.items()}
        named = []
        for number, base in enumerate(_bases(seam, planes[support])):
            own = {k: remove_specks(m[number], _SPECK) for k, m in masks.items() if m[number].any()}
            classes = CATEGORIES if number else VESSELS if seam.nested else CARRIERS
            named.append(_named(_large(own), views, base, completer, classes))
        if all(named):
            proposals.append(Parts.of(len(rows), named[0], named[1], free_id, support))
    return proposals


def parts_inside(
    views: Sequence[RgbdFrame],
    rows: Rows,
    vessel: ObjectEstimate | None,
    id: int,
    planes: Sequence[SupportPlane],
    completer: PoseNamer,
    free_id: int,
) -> list[Parts]:
    """Return the cut between an upright vessel and what it holds; none if it holds nothing.

    No seam of the outline shows a bowl that is hidden in a larger one up to its rim: the upper part is what
    the shape of the vessel leaves unexplained inside its opening.

    Args:
        views: Images without flying pixels.
        rows: Associated detections of each frame.
        vessel: Estimate of the instance as a single object.
        id: Its id.
        planes: Support planes, numbered by ``ObjectDetection.support``.
        completer: Names the parts.
        free_id: Id of the lower part; that of the upper one follows.
    """
    if vessel is None or vessel.category not in VESSELS or vessel.resting != "upright":
        return []
    shown = {k: d for k, row in enumerate(rows) for d in row if d.instance_id == id}
    surface = SurfaceSamples.of(vessel.mesh_world, np.random.default_rng(0), SAMPLES).tree
    held = {k: _held(views[k], d.mask, vessel, surface) for k, d in shown.items()}
    rest = {k: d.mask & ~held[k] for k, d in shown.items()}
    support = next(iter(shown.values())).support
    below = _named(_large(rest), views, planes[support], completer, VESSELS)
    above = _named(_large(held), views, planes[support], completer, CATEGORIES) if below else {}
    return [Parts.of(len(rows), below, above, free_id, support)] if above else []


def parts_of_two_colors(
    views: Sequence[RgbdFrame],
    rows: Rows,
    id: int,
    planes: Sequence[SupportPlane],
    completer: PoseNamer,
    free_id: int,
    may_be_hidden: bool = False,
) -> list[Parts]:
    """Return the cut between two objects of different colour; none if the networks do not name both.

    Args:
        views: Images without flying pixels.
        rows: Associated detections of each frame.
        id: Id of the instance.
        planes: Support planes, numbered by ``ObjectDetection.support``.
        completer: Names the parts.
        free_id: Id of the lower part; that of the upper one follows.
        may_be_hidden: Whether the lower part may be without a name, to be fitted in all classes, below a
            clearly named one: a rim may be all that is seen of it.
    """
    shown = {k: d for k, row in enumerate(rows) for d in row if d.instance_id == id}
    support = next(iter(shown.values())).support
    plane = planes[support]
    cut = color_cut({k: ObjectObservation(views[k], d.mask) for k, d in shown.items()}, plane)
    if cut is None:
        return []
    lower, upper = (_large({k: masks[number] for k, masks in cut.masks.items()}) for number in (0, 1))
    below = _named(lower, views, plane, completer, CARRIERS)
    above = _named(upper, views, raised(plane, cut.height), completer, CATEGORIES)
    if not below and may_be_hidden and above and _score_of(above) >= CLEARLY_NAMED:
        below = {k: unclassified(mask) for k, mask in lower.items()}
    elif not below or not above or _score_of(below) * _score_of(above) < BOTH_NAMED:
        return []
    return [Parts.of(len(rows), below, above, free_id, support)]


def _large(masks: Mapping[int, Bool[np.ndarray, "h w"]]) -> dict[int, Bool[np.ndarray, "h w"]]:
    """Return the masks with enough pixels, by the numbers of the frames."""
    return {k: mask for k, mask in masks.items() if mask.sum() >= MIN_PIXELS}


def _score_of(named: Named) -> float:
    """Return the probability of the class of a part, which is that of all its detections."""
    return next(iter(named.values())).score


def _held(
    view: RgbdFrame, mask: Bool[np.ndarray, "h w"], vessel: ObjectEstimate, surface: KDTree
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of a vessel's mask whose points are off its surface, within its radius."""
    inside = mask & (view.depth > 0)
    points = points_of(view, inside)
    within = np.linalg.norm((points - vessel.T_world_object[:3, 3])[:, :2], axis=1) < vessel.radius
    off = surface.query(points, distance_upper_bound=2 * FAR)[0] > FAR
    result = np.zeros_like(mask)
    result[inside] = off & within
    kernel = np.ones((3, 3), np.uint8)
    result = cv2.morphologyEx(result.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    return remove_specks(result, _SPECK) if result.any() else result


def _bases(seam: Seam, plane: SupportPlane) -> tuple[SupportPlane, SupportPlane]:
    """Return what the lower and the upper object of a stack stand on, for the networks."""
    return plane, plane if seam.nested else raised(plane, seam.height)


def _named(
    masks: Mapping[int, Bool[np.ndarray, "h w"]],
    views: Sequence[RgbdFrame],
    base: SupportPlane,
    completer: PoseNamer,
    classes: Sequence[Category],
) -> dict[int, ObjectDetection]:
    """Return detections of a part in its views, with the class that those showing most of it agree on.

    Where the class network names none of ``classes`` with a probability of ``MIN_CLASS``, the pose network,
    which knows partly hidden objects better, is asked as well. None if both together name none of them.
    """
    largest = sorted(masks, key=lambda k: -int(masks[k].sum()))[:NAMING_VIEWS]
    named = {k: completer.complete(views[k], base, [unclassified(masks[k])])[0] for k in largest}
    named |= {k: completer.posed(views[k], base, [d])[0] for k, d in named.items()}
    known = [d for d in named.values() if not is_unclassified(d)]
    if not known:
        return {}
    possible = np.array([*(category in classes for category in CATEGORIES), True])
    for probabilities in ([d.class_probabilities for d in known], [_of_both_networks(d) for d in known]):
        mean = np.mean(probabilities, axis=0) * possible
        mean /= max(mean.sum(), 1e-9)
        best = int(mean[:OTHER].argmax())
        if mean[best] >= MIN_CLASS:
            break
    else:
        return {}
    common = {"category": CATEGORIES[best], "score": float(mean[best]), "class_probabilities": mean}
    return {k: replace(named.get(k, unclassified(mask)), **common) for k, mask in masks.items()}


def _of_both_networks(detection: ObjectDetection) -> Float[np.ndarray, "k"]:
    """Return class probabilities as the mean of those of the class and of the pose network, in any pose."""
    posed = detection.pose_probabilities
    if not posed.size:
        return detection.class_probabilities
    in_any_pose = [class_mass(posed, category) for category in CATEGORIES]
    return (detection.class_probabilities + np.array([*in_any_pose, posed[-1]])) / 2


def _with_parts(rows: Rows, parts: Mapping[int, Parts]) -> Rows:
    """Return the parts in place of their wholes; all other detections without an id."""
    return [
        [replace(d, instance_id=None) for d in row if d.instance_id not in parts]
        + [d for part in parts.values() for d in part.rows[k]]
        for k, row in enumerate(rows)
    ]


def instance_points(views: Sequence[RgbdFrame], rows: Rows, id: int) -> Float[np.ndarray, "n 3"]:
    """Return a sample of an instance's measured points in the world frame, in metres."""
    masks = [(view, d.mask) for view, row in zip(views, rows) for d in row if d.instance_id == id]
    points = np.concatenate([ObjectObservation(*shown).points_world(erode=2) for shown in masks])
    return points[:: max(1, len(points) // _POINTS)]
