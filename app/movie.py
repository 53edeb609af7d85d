"""Incrementally encoded videos: an MP4 file, and a small WebP animation for web pages."""

from __future__ import annotations

import errno
import os
import shutil
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

Picture = UInt8[np.ndarray, "_h _w 3"]

ANIMATION_WIDTH, ANIMATION_QUALITY = 640, 70  # [px], of WebP: less than 1 MB for a packing episode
ANIMATION_FPS = 6.0  # at most
LONGEST = 20.0  # [s] of an animation; longer videos are sped up in it


@dataclass(frozen=True)
class Encoding:
    """Parameters of the encoder.

    Attributes:
        quality: imageio's quality in 0..10; None if the parameters determine it.
        block: Width and height of the images must be multiples of it, in pixels; others are resized.
        parameters: Further arguments of ffmpeg.
    """

    quality: float | None = 7
    block: int = 8
    parameters: tuple[str, ...] = ("-preset", "veryfast")  # a few per cent larger at half the cost


class MovieFile:
    """Encodes images as they arrive; the file appears under its name when it is complete.

    ``<name>.webp`` beside it has the same content, smaller and with fewer images, unless it is not wanted.
    """

    def __init__(self, path: Path, fps: int, encoding: Encoding = Encoding(), animation: bool = True) -> None:
        import imageio.v2 as imageio

        self._path = path
        self._partial = path.with_name(f".{path.name}.partial.mp4")
        self._fps = fps
        self._animated = animation
        self._last: np.ndarray | None = None
        self._small: list[Image.Image] = []
        self._count = 0
        self._writer: Any = imageio.get_writer(
            self._partial, fps=fps, codec="libx264", quality=encoding.quality,
            macro_block_size=encoding.block, ffmpeg_log_level="quiet",
            output_params=list(encoding.parameters),
        )  # fmt: skip

    def add(self, image: Picture) -> None:
        """Append an image; all images have one size.

        Raises:
            OSError: The encoder failed, as on a full disk.
        """
        if self._animated and self._count % max(1, round(self._fps / ANIMATION_FPS)) == 0:
            height = round(ANIMATION_WIDTH * image.shape[0] / image.shape[1])
            small = cv2.resize(image, (ANIMATION_WIDTH, height), interpolation=cv2.INTER_AREA)
            self._small.append(Image.fromarray(small))
        self._last = image
        self._count += 1
        try:
            self._writer.append_data(image)
        except OSError:  # its message is the encoder's command line
            raise self._failure() from None

    def hold(self, seconds: float) -> None:
        """Repeat the last image for a while."""
        for _ in range(round(seconds * self._fps) if self._last is not None else 0):
            self.add(self._last)  # pyright: ignore[reportArgumentType]

    def close(self) -> None:
        """Complete the files.

        Raises:
            OSError: The encoder failed, as on a full disk.
        """
        self._writer.close()
        if self._count and not is_complete_mp4(self._partial):
            raise self._failure()
        self._partial.replace(self._path)
        if self._small:
            self._write_animation()

    def discard(self) -> None:
        """Delete the incomplete files."""
        self._writer.close()
        self._partial.unlink(missing_ok=True)

    def _failure(self) -> OSError:
        """Return the error of a failed encoder, which does not report its reason."""
        is_full = shutil.disk_usage(self._path.parent).free < 2**20
        number = errno.ENOSPC if is_full else errno.EIO
        return OSError(number, os.strerror(number), str(self._path))

    def _write_animation(self) -> None:
        """Write the WebP animation."""
        seconds = min(self._count / self._fps, LONGEST)
        first, *others = self._small
        partial = self._path.with_name(f".{self._path.stem}.partial.webp")
        first.save(
            partial, save_all=True, append_images=others, duration=round(1000 * seconds / len(self._small)),
            loop=0, quality=ANIMATION_QUALITY, method=2,
        )  # fmt: skip
        partial.replace(self._path.with_suffix(".webp"))


def is_complete_mp4(path: Path) -> bool:
    """Return whether the boxes of an MP4 file fill it and include the index, which is written last."""
    has_index, position = False, 0
    with path.open("rb") as file:
        while len(header := file.read(16)) >= 8:
            length, kind = struct.unpack(">I4s", header[:8])
            if length == 1 and len(header) == 16:
                length = struct.unpack(">Q", header[8:])[0]
            if length < 8:
                return False
            has_index |= kind == b"moov"
            position += length
            file.seek(position)
        return has_index and position == os.fstat(file.fileno()).st_size
