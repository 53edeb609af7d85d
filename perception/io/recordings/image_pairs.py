"""RGB-D frames from pairs of image files, as recordings of cameras store them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from perception.errors import InvalidInputError
from perception.io.images import DEPTH_MODES, read_image
from perception.types import CameraIntrinsics, RgbdFrame

NOMINAL_WIDTH = 640.0  # [px] image width that the calibrations of data sets refer to
SATURATED = 65535  # largest value of a 16-bit depth image, which marks missing depth in 7-Scenes and others


class NominalCamera(NamedTuple):
    """Focal lengths and principal point in pixels of images of a known width.

    Attributes:
        fx, fy: Focal lengths.
        cx, cy: Principal point.
        width: Width of those images; 0 for the width of the recording's own images.
        size: Width and height that the images must have; 0 for any.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: float = NOMINAL_WIDTH
    size: tuple[int, int] = (0, 0)

    def intrinsics(self, width: int, height: int) -> CameraIntrinsics:
        """Return the intrinsics for images of the given size and the same field of view.

        Raises:
            InvalidInputError: The principal point lies outside such images, or the camera is stated for
                images of another size.
        """
        if any(stated not in (0, actual) for stated, actual in zip(self.size, (width, height))):
            stated = "x".join(str(side or "?") for side in self.size)
            raise InvalidInputError(
                f"its camera is stated for images of {stated} px, not {width}x{height}: give --camera for "
                "images of this size"
            )
        fx, fy, cx, cy = np.array(self[:4], float) * (width / self.width if self.width else 1.0)
        if not (0 < cx < width and 0 < cy < height):
            raise InvalidInputError(
                f"principal point ({cx:g}, {cy:g}) lies outside the images of {width}x{height} px: "
                "give the camera of images of this size"
            )
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
        units_per_metre: Unit of the 16-bit depth image; 0 and SATURATED are no measurement.

    Raises:
        InvalidInputError: An image is unusable, the two differ in size, or the camera does not fit them; the
            message names the file.
    """
    pixels = read_image(folder, pair.color, ("RGB", "RGBA"), "8-bit RGB")
    rgb = np.ascontiguousarray(pixels[..., :3])
    raw = read_image(folder, pair.depth, DEPTH_MODES, "16-bit grey")
    if raw.shape != rgb.shape[:2]:
        raise InvalidInputError(
            f"{folder / pair.depth} ({raw.shape[1]}x{raw.shape[0]}) and {pair.color} "
            f"({rgb.shape[1]}x{rgb.shape[0]}) differ in size: register depth to colour"
        )
    height, width = raw.shape
    depth = np.where(raw < SATURATED, raw / units_per_metre, 0).astype(np.float32)
    return RgbdFrame(pair.time, rgb, depth, camera.intrinsics(width, height))
