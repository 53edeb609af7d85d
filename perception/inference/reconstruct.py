"""All objects of a scan: gathers every instance's views, fits each, spreads them over the cores."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool

from perception.errors import PerceptionError
from perception.inference.fit import FitConfig, FitStep, fit_object
from perception.inference.observation import ObjectObservation
from perception.inference.shape_model import Decoder
from perception.types import CATEGORIES, Category, ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

logger = logging.getLogger(__name__)

Progress = Callable[[int, int, str], None]
OnFitStep = Callable[[int, Category, FitStep], None]

_BEHIND = 0.03  # [m] what lies this far behind the object does not hide it


@dataclass(frozen=True)
class Instance:
    """The views of one object."""

    id: int
    category: Category
    score: float
    observations: tuple[ObjectObservation, ...]


def reconstruct(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    decoder: Decoder,
    plane: SupportPlane,
    config: FitConfig | None = None,
    progress: Progress | None = None,
    workers: int | None = None,
    max_views: int = 6,
    on_step: OnFitStep | None = None,
) -> list[ObjectEstimate]:
    """Reconstructs every instance, ordered by id. The same input gives the same output, whatever the workers.

    Args:
        frames: the scan's images with their camera poses.
        detections_per_frame: detections with ``instance_id`` set, one list for each frame.
        decoder: the shape prior.
        plane: what the objects stand on.
        config: of the fits.
        progress: called with (objects done, objects in all, name of the last one).
        workers: objects fitted at a time; the number of cores by default.
        max_views: of one object; those with the largest masks are taken.
        on_step: called with (id, class, step) of a fit, from several threads.
    """
    config = config or FitConfig()
    instances = gather_instances(frames, detections_per_frame, max_views)
    estimates: dict[int, ObjectEstimate] = {}
    workers = workers or os.cpu_count() or 1
    if len(instances) < workers:  # cores without an object of their own help the others
        config = replace(config, threads=workers // max(len(instances), 1))
    with single_threaded_torch(), ThreadPoolExecutor(workers) as pool:
        jobs = {
            pool.submit(
                fit_object,
                one.observations,
                one.category,
                decoder,
                plane,
                config,
                one.id,
                one.score,
                on_step and partial(on_step, one.id, one.category),
            ): one
            for one in instances
        }
        for done, job in enumerate(as_completed(jobs), start=1):
            one = jobs[job]
            try:
                estimates[one.id] = job.result()
            except PerceptionError as error:
                logger.warning("%s_%d cannot be reconstructed: %s", one.category, one.id, error)
            if progress is not None:
                progress(done, len(jobs), f"{one.category}_{one.id}")
    return [estimates[key] for key in sorted(estimates)]


def gather_instances(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    max_views: int = 6,
) -> list[Instance]:
    """The views of every instance, with what other objects hide in them marked as to be ignored."""
    views: dict[int, list[tuple[RgbdFrame, ObjectDetection, np.ndarray]]] = {}
    for frame, detections in zip(frames, detections_per_frame, strict=True):
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
        instances.append(Instance(key, category, score, observations))
    return instances


def hidden_by(
    frame: RgbdFrame, mask: Bool[np.ndarray, "h w"], others: Sequence[Bool[np.ndarray, "h w"]]
) -> Bool[np.ndarray, "h w"]:
    """Pixels of other objects that may hide the one in the mask: all but those clearly behind it."""
    if not others:
        return np.zeros_like(mask)
    union = np.logical_or.reduce(others).astype(np.uint8)
    union = (cv2.dilate(union, np.ones((5, 5), np.uint8)) > 0) & ~mask
    own = frame.depth[mask & (frame.depth > 0)]
    if not own.size:
        return union
    clearly_behind = frame.depth > np.quantile(own, 0.98) + _BEHIND
    return union & ~clearly_behind


@contextmanager
def single_threaded_torch():
    """One thread for each object: several pools on the same cores fight (measured 15 times slower)."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
