"""Depth as a sensor measures it, from a noise-free depth image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, UInt8

from perception.types import CameraIntrinsics
from sim_assets.rendering.depth_sensors.active_stereo import RANGE as STEREO_RANGE
from sim_assets.rendering.depth_sensors.active_stereo import active_stereo
from sim_assets.rendering.depth_sensors.structured_light import RANGE as STRUCTURED_RANGE
from sim_assets.rendering.depth_sensors.structured_light import structured_light
from sim_assets.rendering.depth_sensors.time_of_flight import RANGE as FLIGHT_RANGE
from sim_assets.rendering.depth_sensors.time_of_flight import time_of_flight

DepthNoise = Literal["none", "gaussian", "realsense", "kinect", "tof"]
DEPTH_NOISES: tuple[DepthNoise, ...] = get_args(DepthNoise)

GAUSSIAN_SIGMA = 0.002  # [m]
CLEARANCE = 0.08  # [m] that users keep beyond the least depth of a sensor
SENSORS: dict[str, Callable[..., np.ndarray]] = {
    "realsense": active_stereo,
    "kinect": structured_light,
    "tof": time_of_flight,
}
RANGES = {"realsense": STEREO_RANGE, "kinect": STRUCTURED_RANGE, "tof": FLIGHT_RANGE}


def nearest_depth(noise: DepthNoise) -> float:
    """Return the depth in [m] at which objects can be used with a sensor; 0 without one."""
    return RANGES[noise][0] + CLEARANCE if noise in RANGES else 0.0


def add_depth_noise(
    depth: Float[np.ndarray, "h w"],
    noise: DepthNoise,
    intrinsics: CameraIntrinsics,
    rng: np.random.Generator,
    rgb: UInt8[np.ndarray, "h w 3"] | None = None,
) -> Float[np.ndarray, "h w"]:
    """Return a noisy copy of a noise-free depth image in [m]; pixels without depth (0) stay 0.

    Args:
        depth: (H, W) depth in [m], registered to the colour image.
        noise: none, gaussian (2 mm), realsense (active stereo), kinect (structured light), tof.
        intrinsics: camera of the image.
        rng: random generator.
        rgb: (H, W, 3) colour image, for the sensors' losses on dark and shiny surfaces; uniformly grey
            surfaces by default.

    Raises:
        ValueError: the noise model is unknown.
    """
    if noise not in DEPTH_NOISES:
        raise ValueError(f"depth noise '{noise}' is none of {', '.join(DEPTH_NOISES)}")
    depth = depth.astype(np.float32)
    if noise == "none":
        return depth
    if noise == "gaussian":
        noisy = depth + GAUSSIAN_SIGMA * rng.standard_normal(depth.shape, dtype=np.float32)
        return np.where(depth > 0, np.maximum(noisy, 1e-3), 0).astype(np.float32)
    return SENSORS[noise](depth, intrinsics, rng, rgb)
