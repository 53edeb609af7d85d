"""Tracking of one frame whose masks are associated with landmarks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from perception.slam.association import RenderedMasks
from perception.slam.config import SlamConfig
from perception.slam.labelled_frame import LabelledFrame
from perception.slam.mapping import Mapper
from perception.slam.motion import CameraMotion
from perception.slam.pixels import in_observed_parts, select_pixels
from perception.slam.tracking import TrackedPose, track

_SUSPECT_OUTLIER_FRAMES = 2  # outlier frames from which a landmark is not tracked with


@dataclass(frozen=True)
class TrackedFrame:
    """A frame after association and tracking.

    Attributes:
        view: The frame with its masks, their association and, once it is accepted, its tracked pose.
        tracked: Result of tracking.
        plane_points: Measured points of the plane in the camera frame, in metres.
        unseen_ratios: Share of each landmark's pixels that no keyframe had in view.
        render: Renders the masks of the map from the predicted pose.
    """

    view: LabelledFrame
    tracked: TrackedPose
    plane_points: Float[np.ndarray, "n 3"]
    unseen_ratios: Mapping[int, float]
    render: Callable[[], RenderedMasks]


def track_view(
    mapper: Mapper,
    view: LabelledFrame,
    predicted: CameraMotion,
    render: Callable[[], RenderedMasks],
    config: SlamConfig,
    iterations: int | None = None,
) -> TrackedFrame:
    """Track the camera in a frame with associated masks.

    Args:
        mapper: Map and keyframes.
        view: The frame with the predicted pose.
        predicted: Predicted motion of the camera.
        render: Renders the masks of the map from the predicted pose.
        config: Settings of the system.
        iterations: Largest number of iterations; the config's if None.
    """
    world, T_predicted = mapper.world, predicted.T_world_camera
    tracking = config.tracking if iterations is None else replace(config.tracking, iterations=iterations)
    pixels = select_pixels(view, world.plane, config.pixels)
    observed = in_observed_parts(pixels, world, mapper.keyframes, T_predicted)
    unseen_ratios = {
        int(id): 1 - float(observed[pixels.is_object & (pixels.landmark_ids == id)].mean())
        for id in np.unique(pixels.landmark_ids[pixels.is_object])
    }
    suspects = frozenset(
        id for id, x in world.landmarks.items() if x.n_outlier_frames >= _SUSPECT_OUTLIER_FRAMES
    )
    prior = np.linalg.inv(predicted.pose_covariance)
    tracked = track(world, pixels.subset(observed), T_predicted, tracking, suspects, prior)
    return TrackedFrame(view, tracked, pixels.plane_points, unseen_ratios, render)
