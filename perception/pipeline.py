"""From RGB-D frames to object estimates, stage by stage: load the networks, detect, reconstruct.

    perception = load_perception("auto")
    detections = detect(frames, perception.detector)
    objects = reconstruct_objects(frames, detections, perception.decoder)

``scans`` and ``single_image`` run these stages in one call. All poses and the support plane are in the world
frame.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol, runtime_checkable

from perception.detection.association import associate
from perception.detection.detector import Detector
from perception.errors import InvalidInputError
from perception.inference.reconstruct import (
    OnFitStep,
    OnRejected,
    ReconstructOptions,
    reconstruct,
    single_threaded_torch,
)
from perception.shape.decoder import ShapeDecoder
from perception.support_plane import fit_support_plane
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

if TYPE_CHECKING:
    from perception.detection.huggingface import HuggingFaceDetector

Device = Literal["auto", "cpu", "cuda"]  # the command line's copy is app.options.Device
SHIPPED = "shipped"  # name of the shipped detector
FrameDetector = Callable[[RgbdFrame, SupportPlane], Sequence[ObjectDetection]]


@runtime_checkable
class Progress(Protocol):
    """Callback for the progress of a stage."""

    def __call__(self, done: int, total: int, item: str = "", /) -> None:
        """Receive the numbers of finished and of all items, and the name of the item finished last."""


def no_progress(done: int, total: int, item: str = "", /) -> None:
    """Ignore the progress."""


@dataclass(frozen=True)
class Perception:
    """The networks of the pipeline.

    Attributes:
        detector: Finds and classifies objects in single frames.
        decoder: Shape prior: decodes shape codes to occupancy grids.
    """

    detector: Detector
    decoder: ShapeDecoder


@dataclass(frozen=True)
class Detections:
    """Detections in all frames, associated across them.

    Attributes:
        plane: Support plane in the world frame.
        per_frame: Detections of each frame; detections of one object share their ``instance_id``.
    """

    plane: SupportPlane
    per_frame: tuple[tuple[ObjectDetection, ...], ...]

    @property
    def n_objects(self) -> int:
        """Number of distinct objects."""
        return len({found.instance_id for frame in self.per_frame for found in frame})


def resolve_device(device: Device) -> str:
    """Return the torch device: ``auto`` is CUDA where it is available, else the CPU.

    Raises:
        InvalidInputError: ``cuda`` was requested but is not available.
    """
    import torch

    if device == "cuda" and not torch.cuda.is_available():
        raise InvalidInputError("--device cuda: this machine has no usable CUDA device; use --device cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device


def load_perception(device: Device) -> Perception:
    """Load the shipped networks.

    Raises:
        InvalidInputError: ``cuda`` was requested but is not available.
        PerceptionError: Weights are missing, damaged or differ from their checksums.
    """
    return Perception(load_detector(device), load_decoder(device))


def load_detector(device: Device) -> Detector:
    """Load the shipped detector; raises as ``load_perception``."""
    return Detector.load(resolve_device(device))


def load_decoder(device: Device) -> ShapeDecoder:
    """Load the decoder of the shipped shape prior; raises as ``load_perception``."""
    return ShapeDecoder.load(device=resolve_device(device))


def load_huggingface(detector: str, device: Device) -> HuggingFaceDetector:
    """Load a Hugging Face instance-segmentation model as the detector.

    Args:
        detector: ``hf:MODEL``, MODEL being a name on the hub or a local folder.
        device: Where the model runs.

    Raises:
        InvalidInputError: ``detector`` is not of that form.
        PerceptionError: The model cannot be loaded or has none of the classes.
    """
    kind, _, name = detector.partition(":")
    if kind != "hf" or not name:
        raise InvalidInputError(f"--detector {detector} is neither {SHIPPED} nor hf:MODEL")
    from perception.detection.huggingface import HuggingFaceDetector

    return HuggingFaceDetector.load(name, resolve_device(device))


def detect(
    frames: Sequence[RgbdFrame],
    detector: FrameDetector,
    progress: Progress = no_progress,
    workers: int | None = None,
    plane: SupportPlane | None = None,
) -> Detections:
    """Detect the objects in every frame and associate them across the frames.

    Args:
        frames: Views with camera poses; a single frame may lack its pose, its camera is then the world.
        detector: Finds the objects in one frame, given the plane: a ``Detector`` or any other callable.
        progress: Called after each frame.
        workers: Number of frames processed in parallel; the number of cores if None.
        plane: Support plane in the world frame; fitted to the depth of all frames if None.

    Raises:
        InvalidInputError: There is no frame, or one of several frames has no pose.
        PerceptionError: No support plane is visible.
    """
    plane = plane or fit_support_plane(frames)
    found = []
    with single_threaded_torch(), ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        for detections in pool.map(lambda frame: detector(frame, plane), frames):
            found.append(detections)
            progress(len(found), len(frames))
    return Detections(plane, tuple(map(tuple, associate(frames, found, plane))))


def reconstruct_objects(
    frames: Sequence[RgbdFrame],
    detections: Detections,
    decoder: ShapeDecoder,
    progress: Progress = no_progress,
    on_step: OnFitStep | None = None,
    on_rejected: OnRejected | None = None,
) -> list[ObjectEstimate]:
    """Estimate the complete shape and the pose of every detected object, ordered by id.

    Args:
        frames: Views with camera poses.
        detections: Associated detections of the same frames.
        decoder: Shape prior.
        progress: Called after each object with its name.
        on_step: Called after each Levenberg-Marquardt step with object id, class and step.
        on_rejected: Called with each object that cannot be reconstructed and is left out.
    """
    options = ReconstructOptions(progress=progress, on_step=on_step, on_rejected=on_rejected)
    return reconstruct(frames, detections.per_frame, decoder, detections.plane, options=options)
