"""The main support plane of depth images, for those who need no more than that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from perception.support.surfaces import SurfaceConfig, find_surfaces
from perception.types import RgbdFrame, SupportPlane


def fit_support_plane(
    frames: Sequence[RgbdFrame], config: SurfaceConfig = SurfaceConfig(), seed: int = 0
) -> SupportPlane:
    """Fit the plane of the surface that things stand on; its normal points towards the cameras.

    Args:
        frames: Frames with poses, or a single one, whose pose may be unknown.
        config: Parameters.
        seed: Seed of RANSAC.

    Returns:
        The plane in the world frame; in the camera frame for a frame without pose.

    Raises:
        InvalidInputError: There is no frame, or one of several has no pose.
        PerceptionError: There are too few depth points, or no plane has enough inliers.
    """
    return find_surfaces(frames, replace(config, max_surfaces=1), seed)[0].plane
