"""Conversion of landmarks to object estimates, the interface to the other packages."""

from __future__ import annotations

import logging

import numpy as np

from perception.inference.meshing import EmptyShapeError, MeshConfig, mesh_from_code
from perception.inference.shape_model import Decoder
from perception.slam.landmarks import Landmark, LandmarkMap
from perception.types import CATEGORIES, ObjectEstimate

logger = logging.getLogger(__name__)


def object_estimate(
    landmark: Landmark, decoder: Decoder, config: MeshConfig = MeshConfig()
) -> ObjectEstimate:
    """Return the landmark with its mesh.

    Its score is the posterior probability of its class over all views.

    Raises:
        EmptyShapeError: The shape has no surface.
    """
    pose = landmark.state.pose
    votes = np.exp(landmark.log_votes - landmark.log_votes.max())
    return ObjectEstimate(
        id=landmark.id,
        category=landmark.category,
        code=landmark.state.code,
        T_world_object=pose.T_world_object,
        scale=pose.scale,
        mesh=mesh_from_code(decoder, landmark.category, landmark.state.code, pose.scale, config),
        score=float(votes[CATEGORIES.index(landmark.category)] / votes.sum()),
        n_views=landmark.n_hits,
        residual=landmark.residual,
    )


def object_estimates(world: LandmarkMap, decoder: Decoder) -> list[ObjectEstimate]:
    """Return the estimates of all landmarks that have a surface, in the order of their ids."""
    estimates = []
    for id in world.ids:
        try:
            estimates.append(object_estimate(world.landmarks[id], decoder))
        except EmptyShapeError as error:
            logger.warning("landmark %d skipped: %s", id, error)
    return estimates
