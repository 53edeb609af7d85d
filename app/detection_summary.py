"""What detection saw, in words and as report figures: surfaces, and candidates that are no objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from perception.detection.geometry import camera_pose
from perception.detection.left_out import LeftOut, summarise
from perception.pipeline import Detections
from perception.support.surface import SupportSurface
from perception.types import RgbdFrame


def surface_text(surface: SupportSurface, frame: RgbdFrame) -> str:
    """Return size and distance of a surface in words."""
    below = float(camera_pose(frame)[:3, 3] @ surface.plane.normal - surface.plane.offset)
    size = "of unknown extent"
    if len(surface.outline):
        short, long = sorted(cv2.minAreaRect(surface.outline.astype(np.float32))[1])
        size = f"of {long:.2f} x {short:.2f} m"
    return f"support surface {size}, {below:.2f} m below the camera"


def surface_lines(detections: Detections, frame: RgbdFrame) -> list[str]:
    """Return one line for each support surface."""
    return [surface_text(surface, frame) for surface in detections.surfaces]


def why_nothing(detections: Detections, frames: Sequence[RgbdFrame]) -> str:
    """Return why no object was found in one line: the surfaces, and what was seen on them."""
    surfaces = " and ".join(surface_lines(detections, frames[0]))
    seen = "; ".join(summarise(detections.left_out, len(frames))) or "no candidate was seen"
    where = f" ({surfaces})" if surfaces else ""
    return f"no object was found{where}: {seen}"


def surfaces_as_json(surfaces: Sequence[SupportSurface]) -> list[dict[str, Any]]:
    """Return plane and outline of each surface as plain values, in metres and in the world frame."""
    return [
        {
            "normal": surface.plane.normal.tolist(),
            "offset": float(surface.plane.offset),
            "outline": np.round(surface.corners, 4).tolist(),
        }
        for surface in surfaces
    ]


def left_out_as_json(left_out: Sequence[LeftOut]) -> list[dict[str, Any]]:
    """Return image, reason and bounding box (x, y, width, height) in pixels of each candidate."""
    return [
        {
            "image": candidate.frame,
            "reason": candidate.reason,
            "detail": candidate.detail,
            "box": list(cv2.boundingRect(candidate.mask.view(np.uint8))),
        }
        for candidate in left_out
    ]
