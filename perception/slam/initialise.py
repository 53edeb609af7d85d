"""Initialisation of landmarks: shape and pose inference from one or a few views."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from perception.detection.geometry import touches_border
from perception.errors import PerceptionError
from perception.inference.fit import fit_object
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectObservation, ObjectViews
from perception.inference.problem import FitState
from perception.inference.shape_model import Decoder, linearise
from perception.rendering.pose import ObjectPose
from perception.slam.landmarks import Landmark, bounding_radius, log_probabilities
from perception.types import ObjectDetection, ObjectEstimate, SupportPlane

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class LandmarkViews:
    """What a landmark is fitted to.

    Attributes:
        id: Id of the landmark.
        observations: Views of the object, at least one.
        detection: Class, score and mask in the newest view.
        frame_number: Number of the frame that initialises the landmark.
    """

    id: int
    observations: Sequence[ObjectObservation]
    detection: ObjectDetection
    frame_number: int


def initialise_landmark(
    views: LandmarkViews, decoder: Decoder, plane: SupportPlane, config: FitConfig
) -> Landmark | None:
    """Fit a landmark; None if the fit fails or is no plausible object of the detected class.

    Args:
        views: Views of the object.
        decoder: Shape prior.
        plane: Support plane in the world frame.
        config: Settings of the fit.
    """
    detection, category = views.detection, views.detection.category
    try:
        object_views = ObjectViews(views.id, category, detection.score, tuple(views.observations))
        estimate = fit_object(object_views, decoder, plane, config)
    except PerceptionError as error:
        logger.debug("frame %d: %s not initialised: %s", views.frame_number, category, error)
        return None
    if estimate.status == "implausible":
        logger.debug("frame %d: %s not initialised: implausible fit", views.frame_number, category)
        return None
    return landmark_from_estimate(estimate, views, decoder, config.step[category])


def landmark_from_estimate(
    estimate: ObjectEstimate, views: LandmarkViews, decoder: Decoder, sample_step: float
) -> Landmark:
    """Convert the estimate of a fit to a landmark.

    Args:
        estimate: Result of the fit.
        views: Views that were fitted.
        decoder: Shape prior.
        sample_step: Distance between the renderer's samples, in voxels.
    """
    pose = ObjectPose.of(estimate.T_world_object, estimate.scale)
    state = FitState(pose, np.array(estimate.code, dtype=np.float64))
    shape = linearise(decoder, estimate.category, state.code)
    return Landmark(
        id=estimate.id,
        category=estimate.category,
        state=state,
        shape=shape,
        bounding_radius=bounding_radius(shape, state),
        sample_step=sample_step,
        log_votes=log_probabilities(views.detection),
        score=views.detection.score,
        truncated=touches_border(views.detection.mask),
        first_frame=views.frame_number,
        residual=estimate.residual,
    )


def refitted(landmark: Landmark, fit: Landmark) -> Landmark:
    """Return a new fit of a landmark with the landmark's identity, class votes and counts."""
    return replace(
        fit,
        id=landmark.id,
        log_votes=landmark.log_votes,
        n_hits=landmark.n_hits,
        n_updates=landmark.n_updates + 1,
    )
