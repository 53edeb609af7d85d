"""A new landmark from one view: the single-view inference of ``perception.inference``."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from perception.errors import PerceptionError
from perception.inference.fit import FitConfig, fit_object
from perception.inference.observation import ObjectObservation, ObjectViews
from perception.inference.problem import FitState
from perception.inference.shape_model import Decoder, linearise
from perception.rendering.pose import ObjectPose
from perception.slam.landmarks import Landmark, log_probabilities, reach_of
from perception.types import Category, ObjectDetection, ObjectEstimate, SupportPlane

logger = logging.getLogger(__name__)


def initialise_landmark(
    observations: list[ObjectObservation],
    detection: ObjectDetection,
    decoder: Decoder,
    plane: SupportPlane,
    fit: FitConfig,
    landmark_id: int,
    frame_number: int,
    category: Category | None = None,
) -> Landmark | None:
    """The landmark that the views show, or None if what they show is no plausible object of its class.

    Args:
        observations: its views, usually one.
        detection: its class and votes.
        decoder: the shape prior.
        plane: what it stands on.
        fit: budget of the inference.
        landmark_id: for the landmark.
        frame_number: when.
        category: another class than the detection's, if views have voted otherwise.
    """
    category = category or detection.category
    try:
        views = ObjectViews(landmark_id, category, detection.score, tuple(observations))
        estimate = fit_object(views, decoder, plane, fit)
    except PerceptionError as error:
        logger.debug("no %s from frame %d: %s", category, frame_number, error)
        return None
    if estimate.status == "implausible":
        logger.debug("an implausible %s in frame %d is not taken", category, frame_number)
        return None
    return landmark_of(estimate, decoder, fit, detection, frame_number)


def landmark_of(
    estimate: ObjectEstimate,
    decoder: Decoder,
    fit: FitConfig,
    detection: ObjectDetection,
    frame_number: int,
) -> Landmark:
    """An estimate as a landmark."""
    pose = ObjectPose.of(estimate.T_world_object, estimate.scale)
    state = FitState(pose, np.array(estimate.code, dtype=np.float64))
    shape = linearise(decoder, estimate.category, state.code)
    return Landmark(
        id=estimate.id,
        category=estimate.category,
        state=state,
        shape=shape,
        reach=reach_of(shape, state),
        step=fit.step[estimate.category],
        log_votes=log_probabilities(detection),
        score=detection.score,
        cut=touches_border(detection),
        born=frame_number,
        residual=estimate.residual,
    )


def touches_border(detection: ObjectDetection) -> bool:
    """Whether the image border cuts the detection's mask."""
    return is_cut(detection.mask)


def is_cut(mask: Bool[np.ndarray, "h w"]) -> bool:
    """Whether the image border cuts a mask."""
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def renewed(landmark: Landmark, other: Landmark) -> Landmark:
    """``other`` in the place of the landmark: a better start, the same object and votes."""
    return replace(
        other,
        id=landmark.id,
        log_votes=landmark.log_votes,
        hits=landmark.hits,
        updates=landmark.updates + 1,
    )
