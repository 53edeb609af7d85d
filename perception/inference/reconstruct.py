"""All objects of a scan: gather the views of every instance and fit the instances in parallel."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from itertools import count, zip_longest

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.special import softmax

from perception.depth_cleaning import clean_frame
from perception.inference.acceptance import AcceptanceModel
from perception.inference.class_choice import fit_best_class
from perception.inference.fit import fit_object
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectObservation, ObjectViews, measured_points
from perception.inference.optimisation import FitStep
from perception.inference.rings import is_ring
from perception.inference.scored_fits import RejectedError
from perception.inference.shape_model import Decoder
from perception.inference.stacking import ending_below, find_stacks, rest_on
from perception.inference.warm_start import find_warm_start
from perception.threads import single_threaded
from perception.types import (
    CATEGORIES,
    OTHER,
    Category,
    ObjectDetection,
    ObjectEstimate,
    RejectedObject,
    RgbdFrame,
    SupportPlane,
)

logger = logging.getLogger(__name__)

Progress = Callable[[int, int, str], None]
OnFitStep = Callable[[int, Category, FitStep], None]
OnRejected = Callable[[RejectedObject], None]

_LEAST = 0.005  # smallest probability in one view, so that a single view cannot rule anything out
_OCCLUSION_MARGIN = 0.03  # [m] pixels this far behind an object do not occlude it


@dataclass(frozen=True)
class ReconstructOptions:
    """Scheduling and progress of a reconstruction.

    Attributes:
        workers: Number of objects fitted at a time; None for the number of cores.
        max_views: Largest number of views of one object; those with the largest masks are used.
        progress: Called with (objects done, number of objects, name of the last one).
        on_step: Called with (id, class, step) of a fit, from several threads.
        on_rejected: Called with each object that is left out.
        tentative: Ids of candidates that may well be no objects: to leave them out is not worth a warning.
        rests_on: Id of the object below an object, by its id, where it is known; others are looked for.
        starts: Estimates from fewer images, at which the fits of the same objects start.
        acceptance: Model that compares the classes of an object, and none, by the evidence of their fits and
            gives the score; None fits each object as its detected class, with the detection's score.
    """

    workers: int | None = None
    max_views: int = 6
    progress: Progress | None = None
    on_step: OnFitStep | None = None
    on_rejected: OnRejected | None = None
    tentative: Collection[int] = ()
    rests_on: Mapping[int, int] = field(default_factory=dict)
    starts: Sequence[ObjectEstimate] = ()
    acceptance: AcceptanceModel | None = None


def reconstruct(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    decoder: Decoder,
    plane: SupportPlane | Sequence[SupportPlane],
    config: FitConfig = FitConfig(),
    options: ReconstructOptions = ReconstructOptions(),
) -> list[ObjectEstimate]:
    """Reconstruct every instance; those that cannot be fitted or accepted are logged, reported and left out.

    The result depends on neither the number of workers nor their timing.

    Args:
        frames: Images of the scan with camera poses.
        detections_per_frame: For each frame its detections with ``instance_id``.
        decoder: Shape prior.
        plane: Support plane of the objects, or the planes that ``ObjectDetection.support`` numbers.
        config: Settings of the fits.
        options: Scheduling and progress.

    Returns:
        Estimates ordered by instance id.
    """
    instances = gather_instances(frames, detections_per_frame, options.max_views)
    instances = [replace(views, start=find_warm_start(views, options.starts)) for views in instances]
    planes = (plane,) if isinstance(plane, SupportPlane) else tuple(plane)
    plane_of = {d.instance_id: planes[d.support] for row in detections_per_frame for d in row}
    by_id = {views.id: views for views in instances}
    estimates: dict[int, ObjectEstimate] = {}
    workers = options.workers or os.cpu_count() or 1
    if len(instances) < workers:  # idle cores render for the objects there are
        config = replace(config, threads=workers // max(len(instances), 1))

    def fit(views: ObjectViews, plane: SupportPlane, config: FitConfig = config) -> ObjectEstimate:
        on_step = options.on_step
        report = None if on_step is None else lambda step: on_step(views.id, views.category, step)
        if options.acceptance is None:
            return fit_object(views, decoder, plane, config, report)
        is_detected = views.id not in options.tentative
        return fit_best_class(views, decoder, plane, options.acceptance, config, report, is_detected)

    def fit_resting(views: ObjectViews, fitted: Mapping[int, ObjectEstimate]) -> ObjectEstimate:
        lower, plane = fitted.get(below[views.id]) if views.id in below else None, plane_of[views.id]
        found = fit(views, plane) if lower is None else rest_on(views, lower, plane, config, fit)
        is_judged = options.acceptance is not None and views.class_probabilities.size > 0
        if is_judged and found.rests_on is None and is_ring(found, views.observations, plane):
            reason = "what it stands on is seen through it: a ring"
            raise RejectedError(found.category, found.score, reason)
        return found

    def finish(views: ObjectViews, result: Callable[[], ObjectEstimate], done: int) -> None:
        name = f"{views.category}_{views.id}"
        try:
            estimates[views.id] = result()
        except Exception as error:  # whatever fails for one object must not cost the others
            rejected = RejectedObject(views.id, views.category, one_line(error), _score(error, views))
            level = logging.DEBUG if views.id in options.tentative else logging.WARNING
            logger.log(level, "%s is left out: %s", name, rejected.reason)
            logger.debug("traceback of %s", name, exc_info=error)
            if options.on_rejected is not None:
                options.on_rejected(rejected)
        if options.progress is not None:
            options.progress(done, len(instances), name)

    known, seen = options.rests_on, find_stacks(instances, plane_of)
    below = {upper: lower for upper, lower in {**seen, **known}.items() if known.get(lower) != upper}
    done = count(1)
    with single_threaded(), ThreadPoolExecutor(workers) as pool:
        for wave in waves_of_stacks(instances, below):
            fitted = dict(estimates)
            jobs = {pool.submit(fit_resting, views, fitted): views for views in wave}
            for job in as_completed(jobs):
                finish(jobs[job], job.result, next(done))
            for found in [estimates[views.id] for views in wave if views.id in estimates]:
                if found.rests_on in estimates:
                    lower = estimates[found.rests_on]
                    points = measured_points(by_id[lower.id].observations, erode=2)
                    estimates[lower.id] = ending_below(lower, found, plane_of[lower.id], points)
    return [estimates[key] for key in sorted(estimates)]


def waves_of_stacks(
    instances: Sequence[ObjectViews], below: Mapping[int, int]
) -> Iterator[Sequence[ObjectViews]]:
    """Yield objects that do not depend on each other: those on the support first, then one of each stack.

    Args:
        instances: Objects.
        below: Id of the object below an object, the lowest first.
    """
    yield [views for views in instances if views.id not in below]
    by_id = {views.id: views for views in instances}
    stacks: dict[int, list[ObjectViews]] = {}
    for upper, lowest in below.items():
        for _ in below:  # never more steps than objects, even if two are said to rest on each other
            lowest = below.get(lowest, lowest)
        stacks.setdefault(lowest, []).append(by_id[upper])
    for wave in zip_longest(*stacks.values()):
        yield [views for views in wave if views is not None]


def gather_instances(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    max_views: int = 6,
) -> list[ObjectViews]:
    """Return the views of every instance, ordered by id, with possible occluders marked to be ignored.

    The class of an instance is the most frequent one of its views, its score their mean score.

    Args:
        frames: Images with camera poses.
        detections_per_frame: For each frame its detections; those without ``instance_id`` are skipped.
        max_views: Largest number of views of one instance; those with the largest masks are used.
    """
    views: dict[int, list[tuple[RgbdFrame, ObjectDetection, np.ndarray]]] = {}
    for frame, detections in zip(frames, detections_per_frame, strict=True):
        frame = clean_frame(frame)
        for detection in detections:
            if detection.instance_id is None:
                continue
            others = [other.mask for other in detections if other is not detection]
            ignore = hidden_by(frame, detection.mask, others)
            views.setdefault(detection.instance_id, []).append((frame, detection, ignore))
    instances = []
    for key in sorted(views):
        seen = sorted(views[key], key=lambda view: -int(view[1].mask.sum()))[:max_views]
        votes = [detection.category for _, detection, _ in seen]
        category = max(CATEGORIES, key=votes.count)
        score = float(np.mean([d.score for _, d, _ in seen if d.category == category]))
        observations = tuple(
            ObjectObservation(frame, detection.mask, ignore, detection.yaw_probabilities)
            for frame, detection, ignore in seen
        )
        known = [d.class_probabilities for _, d, _ in seen if len(d.class_probabilities) == OTHER + 1]
        probabilities = np.mean(known, axis=0) if known else np.zeros(0)
        posed = mean_probabilities([d.pose_probabilities for _, d, _ in seen if d.pose_probabilities.size])
        axes = mean_probabilities([d.axis_probabilities for _, d, _ in seen if d.axis_probabilities.size])
        instances.append(ObjectViews(key, category, score, observations, probabilities, posed, axes))
    return instances


def mean_probabilities(per_view: Sequence[Float[np.ndarray, "p"]]) -> Float[np.ndarray, "p"]:
    """Return the normalised geometric mean of the probabilities of several views; empty for none."""
    if not per_view:
        return np.zeros(0)
    return softmax(np.mean([np.log(np.maximum(p, _LEAST)) for p in per_view], axis=0))


def with_estimated_classes(
    detections_per_frame: Sequence[Sequence[ObjectDetection]], estimates: Sequence[ObjectEstimate]
) -> tuple[tuple[ObjectDetection, ...], ...]:
    """Return the detections with class and score of the estimate of their object, if there is one."""
    by_id = {estimate.id: estimate for estimate in estimates}

    def renamed(detection: ObjectDetection) -> ObjectDetection:
        estimate = None if detection.instance_id is None else by_id.get(detection.instance_id)
        if estimate is None:
            return detection
        return replace(detection, category=estimate.category, score=estimate.score)

    return tuple(tuple(renamed(detection) for detection in row) for row in detections_per_frame)


def hidden_by(
    frame: RgbdFrame, mask: Bool[np.ndarray, "h w"], others: Sequence[Bool[np.ndarray, "h w"]]
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of other objects that may occlude the one in the mask: all not clearly behind it."""
    if not others:
        return np.zeros_like(mask)
    union = np.logical_or.reduce(others).astype(np.uint8)
    union = (cv2.dilate(union, np.ones((5, 5), np.uint8)) > 0) & ~mask
    own = frame.depth[mask & (frame.depth > 0)]
    if not own.size:
        return union
    clearly_behind = frame.depth > np.quantile(own, 0.98) + _OCCLUSION_MARGIN
    return union & ~clearly_behind


def _score(error: Exception, views: ObjectViews) -> float:
    """Return the score of an object that is left out, by the evidence if it was measured."""
    return error.score if isinstance(error, RejectedError) else views.score


def one_line(error: Exception) -> str:
    """Return an error's message in one line, or its type if it has none."""
    return " ".join(str(error).split()) or type(error).__name__
