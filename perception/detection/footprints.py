"""Detections of one physical object in several views, grouped by where they stand.

Each detection leaves a footprint on the support plane: the convex hull of its points in the plan view.
Footprints of one object from different viewpoints overlap, footprints of different objects do not. Opposite
views show opposite sides of a slender object, whose footprints may not overlap, but each view's points lie in
the other's mask, a little behind what is seen there. Where a
view merges or splits objects, the object count of most views decides. What has no certain class in one view,
such as a handle, is part of its neighbour if as many other views surely show both as one object of the
neighbour's class.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse.csgraph import connected_components

from perception.detection.geometry import in_image, plan_coordinates, points_of, project
from perception.types import OTHER, ObjectDetection, RgbdFrame, SupportPlane

_POINTS = 2000  # most points of a footprint
_PROBES = 400  # most points that are looked up in another view


@dataclass(frozen=True)
class GroupingConfig:
    """Parameters of the grouping.

    Attributes:
        min_overlap: Smallest intersection of two footprints of one object, as a share of the smaller one.
        merged_share: Share of each of two objects' footprints from which on a detection covering both is
            taken for a merger of them and left out.
        certain: Smallest class probability of an object that is no part of another one.
        whole_score: Smallest class probability of a detection that shows parts of another view as a whole.
        cell: Side of the footprint grid's cells, in metres.
        min_shown: Smallest share of each of two detections' points that lie in the other's mask if both are
            of one object.
        max_behind: Largest median distance of these points behind the surface that is seen there, in metres.
    """

    min_overlap: float = 0.3
    merged_share: float = 0.5
    certain: float = 0.8
    whole_score: float = 0.9
    cell: float = 0.004
    min_shown: float = 0.7
    max_behind: float = 0.11


@dataclass(frozen=True, eq=False)
class Footprint:
    """One detection in the plan view.

    Attributes:
        view: Index of the frame.
        detection: The detection.
        points: Sample of its point cloud in the world frame, in metres.
        hull: Corners of their convex hull along the plane's axes, in metres.
        frame: Image that contains it.
    """

    view: int
    detection: ObjectDetection
    points: Float[np.ndarray, "n 3"]
    hull: Float[np.ndarray, "m 2"]
    frame: RgbdFrame

    @staticmethod
    def of(view: int, detection: ObjectDetection, frame: RgbdFrame, plane: SupportPlane) -> Footprint:
        """Return the footprint of a detection, without mask-border pixels and points on the plane.

        Masks are slightly too large, so both are mostly background.
        """
        core = cv2.erode(detection.mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
        points = points_of(frame, core if core.any() else detection.mask)
        raised = points[plane.height_above(points) > 0.005]
        points = thinned(raised if len(raised) >= 10 else points, _POINTS)
        plan = plan_coordinates(points, plane)
        if len(plan) > 20:  # outliers at depth discontinuities must not stretch the hull
            low, high = np.percentile(plan, (1, 99), axis=0)
            plan = plan[((plan >= low) & (plan <= high)).all(1)]
        hull = cv2.convexHull(plan.astype(np.float32))[:, 0] if len(plan) else np.zeros((0, 2), np.float32)
        return Footprint(view, detection, points, hull, frame)


def thinned(points: Float[np.ndarray, "n d"], most: int) -> Float[np.ndarray, "m d"]:
    """Return every k-th point, as many as ``most`` allows."""
    return points[:: max(1, -(-len(points) // most))]


def _rasterised(hulls: Sequence[np.ndarray], cell: float) -> list[np.ndarray]:
    """Return footprints as bool images on one common plan-view grid."""
    corners = np.concatenate(hulls)
    low = corners.min(0) - 2 * cell
    size = np.ceil((corners.max(0) - low) / cell).astype(int) + 3
    images = []
    for hull in hulls:
        image = np.zeros(size[::-1], np.uint8)
        cv2.fillConvexPoly(image, np.rint((hull - low) / cell).astype(np.int32), 1)
        images.append(image.astype(bool))
    return images


Images = Mapping[Footprint, Bool[np.ndarray, "h w"]]  # on one common plan-view grid


def clusters(footprints: Sequence[Footprint], config: GroupingConfig) -> list[list[Footprint]]:
    """Return the connected components of footprints that overlap across views."""
    if not footprints:
        return []
    linked = np.zeros((len(footprints), len(footprints)), bool)
    for i, a in enumerate(footprints):
        for j, b in enumerate(footprints[:i]):
            gap = np.inf if a.view == b.view else _gap(a.hull, b.hull)
            if gap == 0:
                first, second = _rasterised((a.hull, b.hull), config.cell)
                shared = (first & second).sum()
                linked[i, j] = shared >= config.min_overlap * min(first.sum(), second.sum())
            if gap < config.max_behind and not linked[i, j]:
                linked[i, j] = _is_behind(a, b, config) and _is_behind(b, a, config)
    labels = connected_components(linked, directed=False)[1]
    return [[f for f, k in zip(footprints, labels) if k == label] for label in range(labels.max() + 1)]


def _gap(a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "m 2"]) -> float:
    """Return the distance of two footprints along the plane's axes in metres, 0 if their boxes overlap."""
    return float(np.maximum(a.min(0) - b.max(0), b.min(0) - a.max(0)).clip(0).max())


def _is_behind(hidden: Footprint, seen: Footprint, config: GroupingConfig) -> bool:
    """Return whether the points of a detection lie in another view's mask, a little behind what it shows."""
    frame = seen.frame
    points = thinned(hidden.points, _PROBES)
    pixels, z = project(frame, points)
    inside = in_image(frame, pixels, z)
    u, v = pixels[inside].T
    in_mask = seen.detection.mask[v, u]
    if in_mask.sum() < config.min_shown * len(points):
        return False
    measured = frame.depth[v, u]
    behind = (z[inside] - measured)[in_mask & (measured > 0)]
    return len(behind) > 0 and float(np.median(behind)) < config.max_behind


def separate(cluster: Sequence[Footprint], config: GroupingConfig) -> list[list[Footprint]]:
    """Return one group per physical object of a cluster, each with at most one detection per view."""
    images = dict(zip(cluster, _rasterised([f.hull for f in cluster], config.cell)))
    owners = _owners_of_parts(cluster, images, config)
    groups = _divided([f for f in cluster if f not in owners], images, config)
    for part, owner in owners.items():
        for group in groups:
            if owner in group:
                group.append(part)
    return [_one_per_view(group) for group in groups]


def _owners_of_parts(
    cluster: Sequence[Footprint], images: Images, config: GroupingConfig
) -> dict[Footprint, Footprint]:
    """Return the objects of which detections without a certain class are parts, by the part."""
    named = [f for f in cluster if _is_certain(f.detection, config)]
    split = sum(count > 1 for count in Counter(f.view for f in cluster).values())
    owners = {}
    for part in (f for f in cluster if f not in named):
        for owner in (f for f in named if f.view == part.view):
            wholes = {f.view for f in named if _shows_both(f, part, owner, images, config)}
            if len(wholes) >= split:
                owners[part] = owner
    return owners


def _shows_both(
    whole: Footprint, part: Footprint, owner: Footprint, images: Images, config: GroupingConfig
) -> bool:
    """Return whether a detection of another view surely shows a part and its owner as one object."""
    same = whole.view != part.view and whole.detection.category == owner.detection.category
    return (
        same
        and whole.detection.score >= config.whole_score
        and all(
            (images[whole] & images[f]).sum() > config.merged_share * images[f].sum() for f in (part, owner)
        )
    )


def _is_certain(detection: ObjectDetection, config: GroupingConfig) -> bool:
    p = detection.class_probabilities
    return detection.score >= config.certain and (len(p) != OTHER + 1 or int(np.argmax(p)) != OTHER)


def _divided(cluster: Sequence[Footprint], images: Images, config: GroupingConfig) -> list[list[Footprint]]:
    """Return the detections of each object, possibly several of one view.

    The number of objects is the mode of the views' detection counts, the larger one in a tie: two detections
    in one view are rarely one object. Among the views with that count, one provides the anchors to which the
    other detections are assigned: that with which the fewest are mergers of several, and the largest
    footprints. One that shows an object in pieces makes mergers of all that show it whole.
    """
    count_of_view = Counter(f.view for f in cluster)
    if max(count_of_view.values()) == 1:
        return [list(cluster)]
    votes = Counter(count_of_view.values())
    n_objects = max(votes, key=lambda n: (votes[n], n))
    views = [view for view, n in count_of_view.items() if n == n_objects]
    divisions = [_around([f for f in cluster if f.view == view], cluster, images, config) for view in views]
    return max(divisions, key=lambda groups: (sum(map(len, groups)), sum(images[g[0]].sum() for g in groups)))


def _around(
    anchors: Sequence[Footprint], cluster: Sequence[Footprint], images: Images, config: GroupingConfig
) -> list[list[Footprint]]:
    """Return the detections that cover most of each anchor, without those that cover several of them."""
    groups: list[list[Footprint]] = [[anchor] for anchor in anchors]
    for f in cluster:
        if f in anchors:
            continue
        shared = np.array([(images[f] & images[anchor]).sum() for anchor in anchors])
        covered = shared / np.array([max(images[anchor].sum(), 1) for anchor in anchors])
        if (covered > config.merged_share).sum() <= 1 and shared.max() > 0:  # otherwise it merges several
            groups[int(shared.argmax())].append(f)
    return groups


def _one_per_view(group: list[Footprint]) -> list[Footprint]:
    """Unite the parts of one object in each view: one mask, the class and yaw of the largest part."""
    united = []
    for view in sorted({f.view for f in group}):
        parts = sorted((f for f in group if f.view == view), key=lambda f: -int(f.detection.mask.sum()))
        largest = parts[0]
        if len(parts) > 1:
            mask = np.logical_or.reduce([f.detection.mask for f in parts])
            points = np.concatenate([f.points for f in parts])
            largest = replace(largest, detection=replace(largest.detection, mask=mask), points=points)
        united.append(largest)
    return united
