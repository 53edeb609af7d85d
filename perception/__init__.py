"""From RGB-D images to objects: class, complete shape, pose and uncertainty; no simulator, no robot.

The names below are the public interface; each is imported on first access. Read in this order: ``types`` (the
data), ``pipeline`` (the stages), ``single_image`` and ``scans`` (everything in one call), ``inference`` (the
fit of shape and pose), ``slam``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from perception.detection.left_out import LeftOut as LeftOut
    from perception.errors import InvalidInputError as InvalidInputError
    from perception.errors import PerceptionError as PerceptionError
    from perception.io.object_map import read_object_map as read_object_map
    from perception.io.object_map import write_object_map as write_object_map
    from perception.io.recordings.sequence import RgbdSequence as RgbdSequence
    from perception.io.recordings.sequence import open_sequence as open_sequence
    from perception.io.recordings.trajectory import Trajectory as Trajectory
    from perception.io.recordings.trajectory import write_trajectory as write_trajectory
    from perception.io.scan_folder import Scan as Scan
    from perception.io.scan_folder import read_scan as read_scan
    from perception.io.scan_folder import write_scan as write_scan
    from perception.pipeline import Detections as Detections
    from perception.pipeline import Perception as Perception
    from perception.pipeline import detect as detect
    from perception.pipeline import load_perception as load_perception
    from perception.reconstruction import Reconstruction as Reconstruction
    from perception.scans import reconstruct as reconstruct
    from perception.scans import reconstruct_scan as reconstruct_scan
    from perception.single_image import reconstruct_image as reconstruct_image
    from perception.slam.config import SlamConfig as SlamConfig
    from perception.slam.frame_result import FrameResult as FrameResult
    from perception.slam.system import Slam as Slam
    from perception.support.surface import SupportSurface as SupportSurface
    from perception.support.surfaces import find_surfaces as find_surfaces
    from perception.support_plane import fit_support_plane as fit_support_plane
    from perception.types import CATEGORIES as CATEGORIES
    from perception.types import CameraIntrinsics as CameraIntrinsics
    from perception.types import Category as Category
    from perception.types import ObjectDetection as ObjectDetection
    from perception.types import ObjectEstimate as ObjectEstimate
    from perception.types import RgbdFrame as RgbdFrame
    from perception.types import SupportPlane as SupportPlane
    from perception.types import TriangleMesh as TriangleMesh

_MODULES = {
    "perception.types": (
        "CATEGORIES", "CameraIntrinsics", "Category", "ObjectDetection", "ObjectEstimate", "RgbdFrame",
        "SupportPlane", "TriangleMesh",
    ),
    "perception.errors": ("InvalidInputError", "PerceptionError"),
    "perception.io.scan_folder": ("Scan", "read_scan", "write_scan"),
    "perception.io.object_map": ("read_object_map", "write_object_map"),
    "perception.io.recordings.sequence": ("RgbdSequence", "open_sequence"),
    "perception.io.recordings.trajectory": ("Trajectory", "write_trajectory"),
    "perception.support.surface": ("SupportSurface",),
    "perception.support.surfaces": ("find_surfaces",),
    "perception.support_plane": ("fit_support_plane",),
    "perception.detection.left_out": ("LeftOut",),
    "perception.pipeline": ("Detections", "Perception", "detect", "load_perception"),
    "perception.reconstruction": ("Reconstruction",),
    "perception.scans": ("reconstruct", "reconstruct_scan"),
    "perception.single_image": ("reconstruct_image",),
    "perception.slam.config": ("SlamConfig",),
    "perception.slam.frame_result": ("FrameResult",),
    "perception.slam.system": ("Slam",),
}  # fmt: skip
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'perception' has no attribute '{name}'")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return __all__
