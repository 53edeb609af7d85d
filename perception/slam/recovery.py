"""Whether the pose found for a lost camera is certain enough to continue tracking from it."""

from __future__ import annotations

import numpy as np

from perception.slam.config import SlamConfig
from perception.slam.motion import CameraMotion
from perception.slam.pose_check import check_pose
from perception.slam.tracking import TrackedPose

SEARCH_ITERATIONS = 8  # of tracking near the predicted pose of a lost camera
_SEARCH_MIN_LANDMARKS = 2  # that must agree there
_MIN_INFORMATION = 1e-3  # [1/rad^2], [1/m^2] added to a relocalised pose's, to keep it invertible


def searched_motion(
    tracked: TrackedPose, guess: CameraMotion, config: SlamConfig
) -> tuple[CameraMotion, bool]:
    """Judge a search near the predicted pose.

    Args:
        tracked: Result of tracking from the prediction.
        guess: Predicted motion of the camera.
        config: Settings of the system.

    Returns:
        The updated motion, or the prediction where tracking is implausible; whether the camera is found.
    """
    motion = check_pose(tracked, guess, config.pose_check)[1]
    if motion is None:
        return guess, False
    threshold = config.lifecycle.support_inlier_ratio
    n_agreeing = sum(ratio > threshold for ratio in tracked.inlier_ratios.values())
    return motion, n_agreeing >= _SEARCH_MIN_LANDMARKS and is_certain(motion, config)


def relocalised_motion(tracked: TrackedPose, time: float, period: float, config: SlamConfig) -> CameraMotion:
    """Return the motion of a relocalised camera: its pose, with unknown velocity.

    Args:
        tracked: Pose found by relocalisation.
        time: Capture time, in seconds.
        period: Time between two frames, in seconds.
        config: Settings of the system.
    """
    covariance = np.linalg.inv(tracked.information + _MIN_INFORMATION * np.eye(6))
    return CameraMotion.with_unknown_velocity(time, tracked.T_world_camera, config.motion, covariance, period)


def is_certain(motion: CameraMotion, config: SlamConfig) -> bool:
    """Return whether the position is certain enough to continue tracking."""
    check = config.pose_check
    determined = motion.correlated_position_std < check.lost_correlated_std
    return determined and motion.position_std < check.recovered_position_std
