"""Input of the benchmarks: a scan of six objects, and up to three views of one of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from app.options import Device, ScanOptions
from perception.detection.detector import Detector
from perception.errors import InvalidInputError
from perception.inference.observation import ObjectViews
from perception.inference.reconstruct import gather_instances
from perception.io.scan_folder import read_scan
from perception.pipeline import Detections, detect, load_perception
from perception.rendering.pose import ObjectPose, canonical_from_camera
from perception.rendering.renderer import RayBundle
from perception.shape.decoder import ShapeDecoder
from perception.types import RgbdFrame

OBJECTS = "mug=2,bowl=2,bottle=1,can=1"


@dataclass(frozen=True)
class BenchScene:
    """A scan with its detections, and the networks.

    Attributes:
        frames: Images of the scan.
        detections: Support plane and detections of the images.
        subject: Object of the single fits; a mug with at least three views if there is one.
        detector: Detector.
        decoder: Shape prior.
    """

    frames: tuple[RgbdFrame, ...]
    detections: Detections
    subject: ObjectViews
    detector: Detector
    decoder: ShapeDecoder


def prepare(scan: Path | None, seed: int, device: Device) -> BenchScene:
    """Return the input of the benchmarks from a scan folder, or from a scan of the simulated cell.

    Raises:
        InvalidInputError: No object is detected.
    """
    frames = _simulated(seed) if scan is None else read_scan(scan).frames
    networks = load_perception(device)
    detections = detect(frames, networks.detector)
    instances = gather_instances(frames, detections.per_frame)
    if not instances:
        raise InvalidInputError(f"no object is found in {scan or 'the simulated cell'}: nothing to time")
    subject = max(instances, key=lambda views: (views.category == "mug", min(len(views.observations), 3)))
    return BenchScene(frames, detections, subject, networks.detector, networks.decoder)


def as_captured(frames: Sequence[RgbdFrame]) -> tuple[RgbdFrame, ...]:
    """Return the images as if just captured: what is computed once for each image is timed again."""
    return tuple(replace(frame) for frame in frames)


def _simulated(seed: int) -> tuple[RgbdFrame, ...]:
    from app.task.cell import build_world
    from manipulation.kinematics import Kinematics
    from manipulation.viewpoints import SCAN_VIEWPOINTS, ViewpointScanner

    with build_world(ScanOptions(objects=OBJECTS, seed=seed), "pack") as world:
        return tuple(ViewpointScanner(world, Kinematics(world.arm)).capture(SCAN_VIEWPOINTS))


def square_view(side: int = 64, samples: int = 50) -> tuple[RayBundle, np.ndarray]:
    """Return rays and camera map of a view of a 0.1 m object from 0.5 m at 45 degrees elevation."""
    line = np.linspace(-0.11, 0.11, side)
    u, v = np.meshgrid(line, line)
    directions = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=-1).astype(np.float32)
    rays = RayBundle(directions, np.zeros(u.size, np.int64), np.array([[0.4, 0.6]]), samples)
    half = np.sqrt(0.5)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = [[0, half, -half], [1, 0, 0], [0, -half, -half]]
    T_world_camera[:3, 3] = [0.5 * half, 0, 0.5 * half]
    pose = ObjectPose(np.eye(3), np.zeros(3), np.full(3, 0.1 / 1.8))
    return rays, canonical_from_camera(pose, T_world_camera[None])
