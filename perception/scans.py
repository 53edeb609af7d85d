"""Scans in one call: support plane, detections, complete shapes and poses.

The stages are in ``pipeline``; these functions choose where plane and detections come from and which frames
can be used.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from perception.detection.association import associate_on_surfaces
from perception.detection.completion import Completer, complete_detections, is_complete
from perception.detection.detector import Detector
from perception.detection.on_surfaces import assigned, classified, with_one_support
from perception.errors import InvalidInputError
from perception.inference.reconstruct import with_estimated_classes
from perception.io.scan_folder import Scan, read_scan
from perception.pipeline import Detections, Perception, detect, load_perception, reconstruct_objects
from perception.reconstruction import Reconstruction
from perception.support.surface import SupportSurface
from perception.support.surfaces import find_surfaces
from perception.types import ObjectDetection, RejectedObject, RgbdFrame, SupportPlane

logger = logging.getLogger(__name__)


def reconstruct(
    frames: Sequence[RgbdFrame], perception: Perception | None = None, detections: Detections | None = None
) -> Reconstruction:
    """Reconstruct all objects in the frames.

    Args:
        frames: RGB-D images with their camera poses, or a single one, whose pose may be unknown.
        perception: the networks; the shipped ones by default, on CUDA where it is available.
        detections: support plane and detections of the frames; found by the detector if None.

    Raises:
        InvalidInputError: no frame, or several of which one lacks its pose.
        PerceptionError: no support plane is visible.
    """
    perception = perception or shipped_perception()
    surfaces = () if detections else find_surfaces(frames)
    posed = frames[0].T_world_camera is not None
    frames = [_in_own_frame(frame) for frame in frames]
    detections = detections or detect(frames, perception.detector, surfaces=surfaces)
    per_frame = completed(frames, detections.per_frame, detections.planes, lambda: perception.detector)
    detections = replace(detections, per_frame=per_frame)
    rejected: list[RejectedObject] = []
    objects = reconstruct_objects(frames, detections, perception.decoder, on_rejected=rejected.append)
    return Reconstruction(
        objects=tuple(objects),
        plane=detections.plane,
        detections=with_estimated_classes(detections.per_frame, objects),
        T_world_camera=frames[0].T_world_camera if len(frames) == 1 else None,
        posed=posed,
        rejected=tuple(rejected),
        planes=detections.planes,
    )


def reconstruct_scan(scan: str | Path | Scan, perception: Perception | None = None) -> Reconstruction:
    """Reconstruct all objects of a scan folder.

    Detections or masks of the folder take precedence over the detector. Of a scan without camera poses only
    the first image is used, and its camera is the world frame.

    Args:
        scan: Folder, or the result of ``read_scan``.
        perception: Networks; the shipped ones by default, on CUDA where it is available.

    Raises:
        InvalidInputError: the folder is unusable; the message names the file and the problem.
        PerceptionError: no support plane is visible.
    """
    perception = perception or shipped_perception()
    folder = Path() if isinstance(scan, Scan) else Path(scan)
    scan = scan if isinstance(scan, Scan) else read_scan(scan)
    surfaces = scan_surfaces(scan)
    usable = usable_part(scan)
    for warning in usable.warnings:
        logger.warning("%s", warning)
    detector = perception.detector
    detections = scan_detections(usable, surfaces, lambda: detector, folder)
    detections = detections or detect(usable.frames, detector, surfaces=surfaces)
    result = reconstruct(usable.frames, perception, detections)
    return replace(result, posed=scan.has_poses)


def scan_surfaces(scan: Scan) -> tuple[SupportSurface, ...]:
    """Find the surfaces in all frames, or in the first alone where camera poses are unknown."""
    return find_surfaces(scan.frames if scan.has_poses else scan.frames[:1])


def usable_part(scan: Scan) -> Scan:
    """Return the scan with every frame posed: without poses the first alone, its camera as the world."""
    if scan.has_poses:
        return scan
    first = _in_own_frame(scan.frames[0])
    dropped = len(scan.frames) - 1
    note = (
        (f"the scan has no camera poses: {dropped} images after the first are not used",) if dropped else ()
    )
    detections, masks = scan.detections and scan.detections[:1], scan.masks and scan.masks[:1]
    return Scan((first,), detections, scan.image_ids[:1], (*scan.warnings, *note), masks)


def scan_detections(
    scan: Scan,
    surfaces: Sequence[SupportSurface],
    load_detector: Callable[[], Detector],
    folder: Path = Path(),
) -> Detections | None:
    """Return the scan's own detections, completed, or its masks classified; None where it has neither.

    Args:
        scan: Scan with the camera poses of all frames.
        surfaces: Surfaces that objects may stand on, the main one first. Each object is assigned to the one
            that it stands on, and none is left out for where it stands.
        load_detector: Returns the detector; called only to classify masks or to find the yaw of mugs.
        folder: Folder named in the error message.

    Raises:
        InvalidInputError: ``detections.json`` holds no detection.
    """
    if scan.detections is not None:
        if not any(scan.detections):
            raise InvalidInputError(
                f"{folder / 'detections.json'} is empty: delete it to use the shipped detector"
            )
        found = with_one_support([assigned(*view, surfaces) for view in zip(scan.frames, scan.detections)])
        planes = [surface.plane for surface in surfaces]
        found = completed(scan.frames, found, planes, load_detector)
        if all(detection.instance_id is not None for row in found for detection in row):
            return Detections(surfaces[0].plane, found, tuple(surfaces))
    elif scan.masks is not None:
        classify = load_detector().classify
        found = [classified(*view, surfaces, classify) for view in zip(scan.frames, scan.masks)]
    else:
        return None
    rows, left_out = associate_on_surfaces(scan.frames, found, surfaces)
    return Detections(surfaces[0].plane, rows, tuple(surfaces), left_out)


def completed(
    frames: Sequence[RgbdFrame],
    detections: Sequence[Sequence[ObjectDetection]],
    planes: Sequence[SupportPlane],
    load_detector: Callable[[], Completer],
) -> tuple[tuple[ObjectDetection, ...], ...]:
    """Return the detections completed; the networks are loaded only if something is missing."""
    if all(is_complete(detection) for row in detections for detection in row):
        return tuple(map(tuple, detections))
    return complete_detections(frames, detections, planes, load_detector())


@functools.cache
def shipped_perception() -> Perception:
    """Load the shipped networks once, on CUDA where it is available."""
    return load_perception("auto")


def _in_own_frame(frame: RgbdFrame) -> RgbdFrame:
    """Return a frame without pose with its camera as the world, any other as it is."""
    return frame if frame.T_world_camera is not None else replace(frame, T_world_camera=np.eye(4))
