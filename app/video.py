"""``video.mp4``: the cell on the left, the wrist camera and the stages on the right."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from app.drawing import font

_log = logging.getLogger(__name__)

FPS = 30
SPEED = 5.0  # simulated seconds per second of video
SCENE = (960, 720)  # [px]
SIDE = 400
WRIST = (SIDE, SIDE * 3 // 4)
STAGES = {
    "scan": "Scan",
    "detect": "Detect",
    "reconstruct": "Reconstruct",
    "plan": "Plan",
    "execute": "Execute",
    "verify": "Verify",
}
_BACKGROUND, _TEXT, _FAINT, _ACCENT = (24, 26, 30), (235, 235, 235), (120, 124, 132), (86, 180, 233)


class MovieFile:
    """Encodes images as they come; the file appears under its name when it is complete."""

    def __init__(self, path: Path, fps: int) -> None:
        import imageio.v2 as imageio

        self._path = path
        self._partial = path.with_name(f".{path.name}.partial.mp4")
        self._fps = fps
        self._last: np.ndarray | None = None
        self._writer: Any = imageio.get_writer(
            self._partial, fps=fps, codec="libx264", quality=7, macro_block_size=8, ffmpeg_log_level="error"
        )

    def add(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """One more image, of the size of the others."""
        self._last = image
        self._writer.append_data(image)

    def hold(self, seconds: float) -> None:
        """Stand still."""
        for _ in range(round(seconds * self._fps) if self._last is not None else 0):
            self._writer.append_data(self._last)

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()
        self._partial.replace(self._path)

    def discard(self) -> None:
        """Give up what was written."""
        self._writer.close()
        self._partial.unlink(missing_ok=True)


class VideoWriter:
    """Composes frames and encodes them as they come; the file appears under its name when it is complete."""

    def __init__(self, path: Path, title: str) -> None:
        self._movie = MovieFile(path, FPS)
        self._title = title
        self.n_frames = 0
        self._stage = ""
        self._detail = ""
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def stage(self, name: str, detail: str = "") -> None:
        """What the caption says from now on."""
        self._stage, self._detail = name, detail

    def frame(self, scene: UInt8[np.ndarray, "h w 3"], wrist: UInt8[np.ndarray, "k l 3"]) -> None:
        """Add one frame."""
        self._last = (scene, wrist)
        self.n_frames += 1
        self._movie.add(self._compose(scene, wrist))

    def hold(self, seconds: float, wrist: UInt8[np.ndarray, "k l 3"] | None = None) -> None:
        """Stand still, with another picture in the wrist camera's place where one is given."""
        if self._last is None:
            return
        self._movie.add(self._compose(self._last[0], self._last[1] if wrist is None else wrist))
        self._movie.hold(seconds)

    def close(self) -> None:
        """Finish the file."""
        self._movie.close()

    def discard(self) -> None:
        """Give up what was written."""
        self._movie.discard()

    def _compose(self, scene: np.ndarray, wrist: np.ndarray) -> np.ndarray:
        width, height = SCENE
        canvas = np.full((height, width + SIDE, 3), _BACKGROUND, np.uint8)
        canvas[:, :width] = cv2.resize(scene, SCENE, interpolation=cv2.INTER_CUBIC)
        canvas[: WRIST[1], width:] = cv2.resize(wrist, WRIST, interpolation=cv2.INTER_CUBIC)
        image = Image.fromarray(canvas)
        pen = ImageDraw.Draw(image)
        left, top = width + 24, WRIST[1] + 14
        pen.text((left, top), "wrist camera", fill=_FAINT, font=font(15))
        pen.text((left, top + 34), self._title, fill=_TEXT, font=font(24, bold=True))
        for row, (name, label) in enumerate(STAGES.items()):
            active = name == self._stage
            y = top + 82 + 38 * row
            if active:
                pen.ellipse((left, y + 7, left + 12, y + 19), fill=_ACCENT)
            pen.text((left + 24, y), label, fill=_TEXT if active else _FAINT, font=font(21, bold=active))
        pen.text((left, height - 72), self._detail, fill=_TEXT, font=font(18))
        pen.text((left, height - 36), f"shown at {SPEED:g}x speed", fill=_FAINT, font=font(15))
        return np.asarray(image)
