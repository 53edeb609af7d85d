"""Ways to cut an instance in the two objects of a stack, named by the networks.

A stack is cut at the seams of its outline, between what a vessel holds and the vessel, and between two
colours. The upper part is named as if its support were at the seam.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from perception.detection.completion import PoseNamer
from perception.detection.geometry import points_of
from perception.detection.instances import remove_specks
from perception.detection.poses import class_mass
from perception.inference.color_cuts import color_cut
from perception.inference.contents import VESSELS, find_rim
from perception.inference.explanation import FAR, SAMPLES
from perception.inference.initialise import plane_basis
from perception.inference.observation import ObjectObservation, measured_points
from perception.inference.seams import Seam, find_seams, part_masks
from perception.inference.stack_choice import is_doubtful, is_vessel
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

SURE = 0.7  # least probability of the networks' names of two vessels that look like one
MIN_CLASS = 0.3  # least mean class probability of a part
BOTH_NAMED = 0.3  # least probability of the names of two parts of different colour: things have two as well
CLEARLY_NAMED = 0.9  # least probability of the name of the upper one if the lower one has no name
CARRIERS: tuple[Category, ...] = ("mug", "bowl", "can")  # nothing stands on a bottle
MIN_PIXELS = 150  # of a part in a view
NAMING_VIEWS = 3
TRIALS = 2  # cuts of one stack whose parts are fitted, besides that between two colours, which comes first
# Height [m] of a vessel's floor from which on it may stand in another one, and part of the rim's radius in
# which that is seen.
RAISED_FLOOR, MIDDLE = 0.015, 0.4
_SPECK = 0.05  # smallest separate piece of a mask, as a share of its largest


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


@dataclass(frozen=True)
class StackCuts:
    """Cuts the instances of one scene.

    The lower part of a cut has the free id that its method is given, the upper one the next.

    Attributes:
        views: Images without flying pixels, with camera poses.
        rows: Associated detections of each image.
        planes: Support planes, numbered by ``ObjectDetection.support``.
        completer: Names the parts.
    """

    views: Sequence[RgbdFrame]
    rows: Rows
    planes: Sequence[SupportPlane]
    completer: PoseNamer

    def worth_fitting(
        self, id: int, free_id: int, whole: ObjectEstimate | None, before: float
    ) -> list[Parts]:
        """Return the cuts of an instance whose parts are to be fitted, in that order; none of most objects.

        Args:
            id: Id of the instance.
            free_id: Id of the lower part.
            whole: Estimate of the instance as a single object; None if it was rejected.
            before: Share of its points which that leaves unexplained.
        """
        if is_doubtful(whole, before):
            by_shape = [*self.inside(id, free_id, whole), *self.at_seams(id, free_id)]
            likeliest = sorted(by_shape, key=lambda parts: -parts.probability)[:TRIALS]
            return [*self.between_colors(id, free_id, whole is not None), *likeliest]
        if whole is not None and is_vessel(whole):
            parted = self.between_colors(id, free_id)
            sure = [p for p in parted if p.probability >= SURE and set(p.categories) <= set(VESSELS)]
            nested = self.at_seams(id, free_id, nested_only=True) if self._has_raised_floor(id) else []
            return [*sure, *nested]
        return []

    def _has_raised_floor(self, id: int) -> bool:
        """Return whether the floor that a vessel shows inside is higher than that of one on the plane."""
        shown, plane = self._shown(id)
        seen = [ObjectObservation(self.views[k], d.mask) for k, d in shown.items()]
        points = measured_points(seen, erode=2)
        plan, height = points @ plane_basis(plane)[:2].T, plane.height_above(points)
        rim = find_rim(plan, height)
        if rim is None:
            return False
        middle = height[np.linalg.norm(plan - rim.centre, axis=1) < MIDDLE * rim.radius]
        return len(middle) >= MIN_PIXELS and float(np.median(middle)) > RAISED_FLOOR

    def at_seams(self, id: int, free_id: int, nested_only: bool = False) -> list[Parts]:
        """Return the cuts of an instance at the seams of its outline, at the strongest first.

        Args:
            id: Id of the instance.
            free_id: Id of the lower part.
            nested_only: Whether only those count at which one object stands inside the rim of another.
        """
        shown, plane = self._shown(id)
        seen = {k: ObjectObservation(self.views[k], d.mask) for k, d in shown.items()}
        seams = find_seams(tuple(seen.values()), plane)
        proposals = []
        for seam in [seam for seam in seams if seam.nested or not nested_only]:
            masks = {k: part_masks(view, seam, plane) for k, view in seen.items()}
            named = []
            for number, base in enumerate(_bases(seam, plane)):
                own = {k: remove_specks(m[number], _SPECK) for k, m in masks.items() if m[number].any()}
                classes = CATEGORIES if number else VESSELS if seam.nested else CARRIERS
                named.append(self._named(_large(own), base, classes))
            if all(named):
                proposals.append(self._parts(shown, named[0], named[1], free_id))
        return proposals

    def inside(self, id: int, free_id: int, vessel: ObjectEstimate | None) -> list[Parts]:
        """Return the cut between an upright vessel and what it holds; none if it holds nothing.

        No seam of the outline shows a bowl that is hidden in a larger one up to its rim: the upper part is
        what the shape of the vessel leaves unexplained inside its opening.

        Args:
            id: Id of the instance.
            free_id: Id of the lower part.
            vessel: Estimate of the instance as a single object; None if it was rejected.
        """
        if vessel is None or not is_vessel(vessel):
            return []
        shown, plane = self._shown(id)
        surface = SurfaceSamples.of(vessel.mesh_world, np.random.default_rng(0), SAMPLES).tree
        held = {k: _held(self.views[k], d.mask, vessel, surface) for k, d in shown.items()}
        rest = {k: d.mask & ~held[k] for k, d in shown.items()}
        below = self._named(_large(rest), plane, VESSELS)
        above = self._named(_large(held), plane, CATEGORIES) if below else {}
        return [self._parts(shown, below, above, free_id)] if above else []

    def between_colors(self, id: int, free_id: int, may_be_hidden: bool = False) -> list[Parts]:
        """Return the cut between two objects of different colour; none if the networks do not name both.

        Args:
            id: Id of the instance.
            free_id: Id of the lower part.
            may_be_hidden: Whether the lower part may be without a name, to be fitted in all classes, below a
                clearly named one: a rim may be all that is seen of it.
        """
        shown, plane = self._shown(id)
        cut = color_cut({k: ObjectObservation(self.views[k], d.mask) for k, d in shown.items()}, plane)
        if cut is None:
            return []
        lower, upper = (_large({k: masks[number] for k, masks in cut.masks.items()}) for number in (0, 1))
        below = self._named(lower, plane, CARRIERS)
        above = self._named(upper, raised(plane, cut.height), CATEGORIES)
        if not below and may_be_hidden and above and _score_of(above) >= CLEARLY_NAMED:
            below = {k: unclassified(mask) for k, mask in lower.items()}
        elif not below or not above or _score_of(below) * _score_of(above) < BOTH_NAMED:
            return []
        return [self._parts(shown, below, above, free_id)]

    def _shown(self, id: int) -> tuple[Named, SupportPlane]:
        """Return the detections of an instance by the numbers of the frames, and its support plane."""
        shown = {k: d for k, row in enumerate(self.rows) for d in row if d.instance_id == id}
        return shown, self.planes[next(iter(shown.values())).support]

    def _parts(self, shown: Named, below: Named, above: Named, free_id: int) -> Parts:
        support = next(iter(shown.values())).support
        return Parts.of(len(self.rows), below, above, free_id, support)

    def _named(
        self,
        masks: Mapping[int, Bool[np.ndarray, "h w"]],
        base: SupportPlane,
        classes: Sequence[Category],
    ) -> dict[int, ObjectDetection]:
        """Return detections of a part in its views, with the class that those showing most of it agree on.

        Where the class network names none of ``classes`` with a probability of ``MIN_CLASS``, the pose
        network, which knows partly hidden objects better, is asked as well. Empty if both together name none.
        """
        completer, views = self.completer, self.views
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


def _of_both_networks(detection: ObjectDetection) -> Float[np.ndarray, "k"]:
    """Return class probabilities as the mean of those of the class and of the pose network, in any pose."""
    posed = detection.pose_probabilities
    if not posed.size:
        return detection.class_probabilities
    in_any_pose = [class_mass(posed, category) for category in CATEGORIES]
    return (detection.class_probabilities + np.array([*in_any_pose, posed[-1]])) / 2
