"""Result of tracking one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from perception.slam.pose_check import Status


@dataclass(frozen=True)
class FrameResult:
    """Result of tracking one frame.

    Attributes:
        number: Index of the frame in the sequence.
        time: Capture time, in seconds.
        T_world_camera: Estimated camera pose; the prediction while the camera is lost.
        status: "tracked", "weak" (large position uncertainty) or "lost".
        position_std: Standard deviation of the camera position along its least certain direction, in metres.
        landmark_of: Landmark id of each associated label of the frame's masks.
        is_detected: Whether the masks are of the detector; otherwise they are rendered from the map.
        new: Ids of the landmarks initialised in this frame.
        retired: Ids of the landmarks removed in this frame.
        is_keyframe: Whether the frame became a keyframe.
        seconds: Duration of each stage: detect, track, initialise, joint, relocalise.
    """

    number: int
    time: float
    T_world_camera: Float[np.ndarray, "4 4"]
    status: Status
    position_std: float = 0.0
    landmark_of: Mapping[int, int] = field(default_factory=dict)
    is_detected: bool = False
    new: tuple[int, ...] = ()
    retired: tuple[int, ...] = ()
    is_keyframe: bool = False
    seconds: Mapping[str, float] = field(default_factory=dict)
