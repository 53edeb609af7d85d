"""Plausibility and certainty of a tracked camera pose: tracked, weak or lost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from perception.geometry import invert
from perception.slam.motion import CameraMotion
from perception.slam.tracking import TrackedPose

Status = Literal["tracked", "weak", "lost"]


@dataclass(frozen=True)
class PoseCheckConfig:
    """Thresholds between the tracking states "tracked", "weak" and "lost".

    Standard deviations are those of the camera position along its least certain direction, in metres.

    Attributes:
        inlier_ratio_min: Median inlier ratio of the used landmarks below which the camera is lost.
        max_translation, max_rotation: Correction of the predicted pose beyond which the camera is lost, in
            metres and radians.
        weak_position_std, lost_position_std: Standard deviation above which the pose is weak, or lost.
        lost_correlated_std: The same for any correlation between the errors of successive frames, above which
            the pose is lost: the landmarks in view do not determine it, however often they are seen.
        recovered_position_std: Standard deviation below which a lost camera is tracked again.
        local_search_position_std: Standard deviation of the predicted position below which a lost camera is
            first searched for near its prediction.
    """

    inlier_ratio_min: float = 0.5
    max_translation: float = 0.10
    max_rotation: float = np.radians(12.0)
    weak_position_std: float = 0.01
    lost_position_std: float = 0.02
    lost_correlated_std: float = 0.021
    recovered_position_std: float = 0.015
    local_search_position_std: float = 0.06


def check_pose(
    tracked: TrackedPose, predicted: CameraMotion, config: PoseCheckConfig = PoseCheckConfig()
) -> tuple[Status, CameraMotion | None]:
    """Return the tracking status, and the updated motion unless the pose is implausible.

    Args:
        tracked: Result of tracking from the predicted pose.
        predicted: Predicted motion of the camera.
        config: Thresholds.
    """
    correction = invert(predicted.T_world_camera) @ tracked.T_world_camera
    angle = np.arccos(np.clip((np.trace(correction[:3, :3]) - 1) / 2, -1, 1))
    plausible = (
        np.isfinite(tracked.T_world_camera).all()
        and tracked.median_inlier_ratio_of_used >= config.inlier_ratio_min
        and np.linalg.norm(correction[:3, 3]) < config.max_translation
        and angle < config.max_rotation
    )
    if not plausible:
        return "lost", None
    motion = predicted.update(tracked.T_world_camera, tracked.information)
    undetermined = motion.correlated_position_std > config.lost_correlated_std
    if undetermined or motion.position_std > config.lost_position_std:
        return "lost", motion
    return "weak" if motion.position_std > config.weak_position_std else "tracked", motion
