"""Detection in one frame on each of several support surfaces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool

from perception.detection.geometry import touches_border
from perception.detection.left_out import LeftOut
from perception.support.extent import ExtentConfig, seen_extent
from perception.support.planes import PlaneConfig
from perception.support.samples import sample_frames
from perception.support.standing import MeasuredObject, misplacement, support_of
from perception.support.surface import SupportSurface
from perception.support.things import ThingConfig, things_on
from perception.types import ObjectDetection, RgbdFrame, SupportPlane

FrameDetector = Callable[[RgbdFrame, SupportPlane], Sequence[ObjectDetection]]
Examined = tuple[list[ObjectDetection], list[LeftOut]]

_SAME = 0.5  # share of the smaller of two masks from which on they show one object


@runtime_checkable
class SurfaceDetector(Protocol):
    """A detector that reports what it leaves out."""

    def examine(
        self, frame: RgbdFrame, surfaces: Sequence[SupportSurface], support: int = 0
    ) -> tuple[list[ObjectDetection], list[LeftOut]]:
        """Return the objects that stand on ``surfaces[support]``, and the candidates left out."""
        ...


def examine_frame(frame: RgbdFrame, detector: FrameDetector, surfaces: Sequence[SupportSurface]) -> Examined:
    """Return the detections on all surfaces, each with its ``support``, and the candidates left out.

    A ``SurfaceDetector`` runs once for each surface that carries something in this frame. Any other detector
    runs once; its detections are assigned to the surfaces that they stand on.
    """
    if isinstance(detector, SurfaceDetector):
        found, left_out = detector.examine(frame, surfaces)
        for support in range(1, len(surfaces)):
            there, rest = _examine_other(frame, detector, surfaces, support)
            found, left_out = found + there, left_out + rest
    else:
        found, left_out = placed(frame, detector(frame, surfaces[0].plane), surfaces)
    found = _without_repetitions(found)
    return found, [c for c in left_out if not any(_overlap(c.mask, d.mask) > _SAME for d in found)]


def _examine_other(
    frame: RgbdFrame, detector: SurfaceDetector, surfaces: Sequence[SupportSurface], support: int
) -> Examined:
    """Return the detections on another surface than the main one, among the things that depth shows on it.

    Things that are cut by the image border are left out: little of them was seen, and of their surface.
    """
    whole = [mask for mask in raised_masks(frame, surfaces[support]) if not touches_border(mask)]
    if not whole:
        return [], []
    found, left_out = detector.examine(frame, surfaces, support)
    kept = [d for d in found if any(_overlap(d.mask, mask) > _SAME for mask in whole)]
    cut = [LeftOut(d.mask, "cut by the image border") for d in found if not any(d is k for k in kept)]
    return kept, left_out + cut


def placed(
    frame: RgbdFrame, detections: Sequence[ObjectDetection], surfaces: Sequence[SupportSurface]
) -> Examined:
    """Return the detections with the surface that each stands on, and those that stand on none."""
    found: list[ObjectDetection] = []
    left_out: list[LeftOut] = []
    for detection in detections:
        seen = MeasuredObject.of(frame, detection.mask)
        support = support_of(seen, surfaces) if seen else 0
        fault = misplacement(seen, surfaces[support]) if seen else None
        if fault is not None:
            left_out.append(fault)
        else:
            found.append(replace(detection, support=support))
    return found, left_out


def supports_of(
    frame: RgbdFrame, masks: Sequence[Bool[np.ndarray, "h w"]], surfaces: Sequence[SupportSurface]
) -> list[int]:
    """Return the index of the surface that the object in each mask stands on, 0 if that is unknown."""
    if len(surfaces) == 1:
        return [0] * len(masks)
    measured = [MeasuredObject.of(frame, mask) for mask in masks]
    return [support_of(seen, surfaces) if seen else 0 for seen in measured]


def classified(
    frame: RgbdFrame,
    masks: Sequence[Bool[np.ndarray, "h w"]],
    surfaces: Sequence[SupportSurface],
    classify: Callable[..., list[ObjectDetection]],
) -> list[ObjectDetection]:
    """Return the masks classified, each relative to the surface that its object stands on.

    Args:
        frame: RGB-D image.
        masks: Pixels of each instance.
        surfaces: Surfaces that objects may stand on, the main one first.
        classify: ``Detector.classify``.
    """
    supports = supports_of(frame, masks, surfaces)
    found = []
    for index, surface in enumerate(surfaces):
        there = [mask for mask, support in zip(masks, supports) if support == index]
        if there:
            found += [_moved(d, index) for d in classify(frame, surface.plane, there)]
    return found


def assigned(
    frame: RgbdFrame, detections: Sequence[ObjectDetection], surfaces: Sequence[SupportSurface]
) -> list[ObjectDetection]:
    """Return given detections with the surface that each stands on; none is left out."""
    supports = supports_of(frame, [detection.mask for detection in detections], surfaces)
    return [_moved(detection, support) for detection, support in zip(detections, supports)]


def with_one_support(rows: Sequence[Sequence[ObjectDetection]]) -> list[list[ObjectDetection]]:
    """Return the detections with the surface that most views of their instance assign it to."""
    votes: dict[int | None, list[int]] = {}
    for detection in (detection for row in rows for detection in row):
        if detection.instance_id is not None:
            votes.setdefault(detection.instance_id, []).append(detection.support)
    common = {instance: max(sorted(set(chosen)), key=chosen.count) for instance, chosen in votes.items()}
    return [[_moved(d, common.get(d.instance_id, d.support)) for d in row] for row in rows]


def _moved(detection: ObjectDetection, support: int) -> ObjectDetection:
    return detection if detection.support == support else replace(detection, support=support)


def raised_masks(frame: RgbdFrame, surface: SupportSurface) -> list[Bool[np.ndarray, "h w"]]:
    """Return a coarse mask of each thing that depth shows on the surface, whatever it is."""
    planes = PlaneConfig()
    samples = sample_frames([frame], planes.min_points, planes.max_depth)
    extent = seen_extent(samples, surface.plane, planes, ExtentConfig())
    if extent is None:
        return []
    things, n_things = things_on(samples, extent, np.zeros(len(samples.valid), bool), ThingConfig())
    ((rows, columns),) = samples.shapes
    size = frame.depth.shape[::-1]
    index = cv2.resize(things.reshape(rows, columns).astype(np.int16), size, interpolation=cv2.INTER_NEAREST)
    return [np.asarray(index) == k for k in range(n_things)]


def unrecognised(
    frame: RgbdFrame, surfaces: Sequence[SupportSurface], left_out: Sequence[LeftOut]
) -> list[LeftOut]:
    """Return the things that depth shows on the surfaces and no candidate covers."""
    masks = [mask for surface in surfaces for mask in raised_masks(frame, surface)]
    return [
        LeftOut(mask, "not recognised as an object", f"{int(mask.sum())} px")
        for mask in masks
        if not any(_overlap(mask, candidate.mask) > 0.3 for candidate in left_out)
    ]


def _without_repetitions(found: list[ObjectDetection]) -> list[ObjectDetection]:
    """Return the detections without those that show an object of another surface with a higher score."""
    repeated = {
        id(min(a, b, key=lambda detection: detection.score))
        for a, b in combinations(found, 2)
        if a.support != b.support and _overlap(a.mask, b.mask) > _SAME
    }
    return [detection for detection in found if id(detection) not in repeated]


def _overlap(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    """Return the intersection as a share of the smaller mask."""
    return float((a & b).sum() / max(1, min(a.sum(), b.sum())))
