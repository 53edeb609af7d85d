"""From frames to objects: detect, associate, reconstruct. Perception alone; no simulator, no robot."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from perception.detection.association import associate
from perception.detection.detector import Detector
from perception.errors import InvalidInputError
from perception.inference.reconstruct import OnFitStep, reconstruct, single_threaded_torch
from perception.shape.decoder import ShapeDecoder
from perception.support_plane import fit_support_plane
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

if TYPE_CHECKING:
    from perception.detection.huggingface import HuggingFaceDetector

Device = Literal["auto", "cpu", "cuda"]
SHIPPED = "shipped"  # the detector that comes along
Progress = Callable[..., None]  # (done, total, and perhaps what)


@dataclass(frozen=True)
class Perception:
    """The networks that perception runs on."""

    detector: Detector
    decoder: ShapeDecoder


@dataclass(frozen=True)
class Detections:
    """What the frames show.

    Attributes:
        plane: what the objects stand on, in the world frame.
        per_frame: for each frame its detections; one object has one ``instance_id`` in all of them.
    """

    plane: SupportPlane
    per_frame: tuple[tuple[ObjectDetection, ...], ...]

    @property
    def n_objects(self) -> int:
        return len({found.instance_id for frame in self.per_frame for found in frame})


def resolve_device(device: Device) -> str:
    """``auto`` resolved; asking for CUDA where there is none is refused.

    Raises:
        InvalidInputError: no CUDA device.
    """
    import torch

    if device == "cuda" and not torch.cuda.is_available():
        raise InvalidInputError("--device cuda: this machine has no usable CUDA device; use --device cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device


def load_perception(device: Device) -> Perception:
    """The shipped networks.

    Raises:
        PerceptionError: weights are missing or damaged.
    """
    return Perception(load_detector(device), load_decoder(device))


def load_detector(device: Device) -> Detector:
    return Detector.load(resolve_device(device))


def load_huggingface(detector: str, device: Device) -> HuggingFaceDetector:
    """The detector of ``hf:MODEL``.

    Raises:
        InvalidInputError: it is not of that form.
        PerceptionError: its weights can't be had.
    """
    kind, _, name = detector.partition(":")
    if kind != "hf" or not name:
        raise InvalidInputError(f"--detector {detector} is neither {SHIPPED} nor hf:MODEL")
    from perception.detection.huggingface import HuggingFaceDetector

    return HuggingFaceDetector.load(name, resolve_device(device))


def load_decoder(device: Device) -> ShapeDecoder:
    return ShapeDecoder.load(device=resolve_device(device))


def detect(
    frames: Sequence[RgbdFrame],
    detector: Detector,
    progress: Progress = lambda *_: None,
    workers: int | None = None,
    plane: SupportPlane | None = None,
) -> Detections:
    """Find the support plane, if it isn't given, and the objects in every frame, and tie them together.

    ``workers`` frames are looked at at a time, by default one on each core.
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
    progress: Progress = lambda *_: None,
    on_step: OnFitStep | None = None,
) -> list[ObjectEstimate]:
    """Whole shapes and poses of the detected objects."""
    return reconstruct(
        frames, detections.per_frame, decoder, detections.plane, progress=progress, on_step=on_step
    )
