"""RGB-D frames from pairs of image files, as recordings of cameras store them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from perception.errors import InvalidInputError
from perception.io.images import DEPTH_MODES, read_image
from perception.types import CameraIntrinsics, RgbdFrame

NOMINAL_WIDTH = 640.0  # [px] image width that a NominalCamera refers to


class NominalCamera(NamedTuple):
    """Focal lengths and principal point in pixels of images that are 640 pixels wide."""

    fx: float
    fy: float
    cx: float
    cy: float

    def intrinsics(self, width: int, height: int) -> CameraIntrinsics:
        """Return the intrinsics for images of the given size and the same field of view."""
        fx, fy, cx, cy = np.array(self) * (width / NOMINAL_WIDTH)
        return CameraIntrinsics(width, height, float(fx), float(fy), float(cx), float(cy))


class ImagePair(NamedTuple):
    """A colour and a depth image of one time.

    Attributes:
        time: Capture time in seconds.
        color: Path of the colour image relative to the recording.
        depth: Path of the depth image relative to the recording.
    """

    time: float
    color: str
    depth: str


def read_pair(folder: Path, pair: ImagePair, camera: NominalCamera, units_per_metre: float) -> RgbdFrame:
    """Read a pair as a frame without pose.

    Args:
        folder: Folder of the recording.
        pair: Files of the images, registered to each other.
        camera: Camera of both.
        units_per_metre: Unit of the 16-bit depth image.

    Raises:
        InvalidInputError: An image is unusable, or the two differ in size; the message names the file.
    """
    pixels = read_image(folder, pair.color, ("RGB", "RGBA"), "8-bit RGB")
    rgb = np.ascontiguousarray(pixels[..., :3])
    raw = read_image(folder, pair.depth, DEPTH_MODES, "16-bit grey")
    if raw.shape != rgb.shape[:2]:
        raise InvalidInputError(f"{folder / pair.depth} and {pair.color} differ in size: register them")
    height, width = raw.shape
    depth = (raw / units_per_metre).astype(np.float32)
    return RgbdFrame(pair.time, rgb, depth, camera.intrinsics(width, height))
