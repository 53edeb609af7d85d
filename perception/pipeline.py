"""From RGB-D frames to object estimates, stage by stage: load the networks, detect, reconstruct.

    perception = load_perception("auto")
    detections = detect(frames, perception.detector)
    objects = reconstruct_objects(frames, detections, perception.decoder)

``scans`` and ``single_image`` run these stages in one call. All poses and the support plane are in the world
frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, Protocol, runtime_checkable

from perception.detection.association import associate_on_surfaces
from perception.detection.completion import PoseNamer
from perception.detection.detector import Detector
from perception.detection.left_out import LeftOut
from perception.detection.on_surfaces import FrameDetector, examine_frame, placed, unrecognised
from perception.errors import InvalidInputError
from perception.inference.acceptance import shipped_acceptance
from perception.inference.reconstruct import (
    OnFitStep,
    OnRejected,
    ReconstructOptions,
    reconstruct,
)
from perception.obstacles.one_view import parts_of_things_in_one_view
from perception.obstacles.same_colour import SAME_COLOUR
from perception.shape.decoder import ShapeDecoder
from perception.support.surface import SupportSurface
from perception.support.surfaces import find_surfaces
from perception.threads import single_threaded, worker_pool
from perception.types import ObjectDetection, ObjectEstimate, RejectedObject, RgbdFrame, SupportPlane
from perception.warp_runtime import warp_has_cuda

if TYPE_CHECKING:
    from perception.detection.huggingface import HuggingFaceDetector

Device = Literal["auto", "cpu", "cuda"]  # the command line's copy is app.options.Device
Complete = Callable[[Sequence[Sequence[ObjectDetection]]], Sequence[Sequence[ObjectDetection]]]
SHIPPED = "shipped"  # name of the shipped detector


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
        plane: Main support plane in the world frame.
        per_frame: Detections of each frame; detections of one object share their ``instance_id``.
        surfaces: Surfaces that objects stand on, which ``ObjectDetection.support`` numbers; the first is the
            main one. Empty if there is no other and its extent is unknown.
        left_out: Candidates that are not reported as objects, each with the reason.
    """

    plane: SupportPlane
    per_frame: tuple[tuple[ObjectDetection, ...], ...]
    surfaces: tuple[SupportSurface, ...] = ()
    left_out: tuple[LeftOut, ...] = ()

    @property
    def planes(self) -> tuple[SupportPlane, ...]:
        """Support planes of all surfaces, the main one first."""
        return tuple(surface.plane for surface in self.surfaces) or (self.plane,)

    @property
    def n_objects(self) -> int:
        """Number of distinct objects."""
        return len({found.instance_id for frame in self.per_frame for found in frame})


def resolve_device(device: Device) -> str:
    """Return the device of the networks: ``auto`` is CUDA where it is available, else the CPU.

    Raises:
        InvalidInputError: ``cuda`` was requested but is not available.
    """
    if device == "cpu" or not has_cuda():
        if device == "cuda":
            raise InvalidInputError("--device cuda: this machine has no usable CUDA device; use --device cpu")
        return "cpu"
    return "cuda"


def has_cuda() -> bool:
    """Return whether both Warp and PyTorch can use CUDA; PyTorch is loaded only where Warp can."""
    if not warp_has_cuda():
        return False
    import torch

    return torch.cuda.is_available()


def load_perception(device: Device) -> Perception:
    """Load the shipped networks.

    Raises:
        InvalidInputError: ``cuda`` was requested but is not available.
        PerceptionError: Weights are missing, damaged or differ from their checksums.
    """
    return Perception(load_detector(device), load_decoder(device))


def load_detector(device: Device) -> Detector:
    """Load the shipped detector; raises as ``load_perception``."""
    with single_threaded():  # hundreds of small tensors: starting threads for each would cost most
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
    surfaces: Sequence[SupportSurface] | None = None,
    max_surfaces: int | None = None,
) -> Detections:
    """Detect the objects in every frame and associate them across the frames.

    Args:
        frames: Views with camera poses; a single frame may lack its pose, its camera is then the world.
        detector: Finds the objects in one frame, given the plane: a ``Detector`` or any other callable.
        progress: Called after each frame.
        workers: Number of frames processed in parallel; the number of cores if None.
        plane: The only support plane in the world frame, of unknown extent, if ``surfaces`` is None.
        surfaces: Surfaces that objects may stand on, the main one first; found in the depth of all frames if
            this and ``plane`` are None.
        max_surfaces: Largest number of surfaces that are found; 1 for the main one alone.

    Raises:
        InvalidInputError: There is no frame, or one of several frames has no pose.
        PerceptionError: No support plane is visible.
    """
    if surfaces is None:
        surfaces = (SupportSurface(plane),) if plane else find_surfaces(frames)[:max_surfaces]
    found: list[list[ObjectDetection]] = []
    left_out: list[LeftOut] = []
    with single_threaded(), worker_pool(workers) as pool:
        for there, rest in pool.map(lambda frame: examine_frame(frame, detector, surfaces), frames):
            left_out += [replace(candidate, frame=len(found)) for candidate in rest]
            found.append(there)
            progress(len(found), len(frames))
    return _associated(frames, found, surfaces, left_out)


def place_detections(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    surfaces: Sequence[SupportSurface],
    complete: Complete = lambda rows: rows,
) -> Detections:
    """Associate the detections of a detector without depth; those that stand on no surface are left out.

    Args:
        frames: Views with camera poses; a single frame may lack its pose.
        detections_per_frame: Detections of each frame.
        surfaces: Surfaces that objects may stand on, the main one first.
        complete: Adds what the detector does not provide, once the surfaces are known.
    """
    views = [placed(*view, surfaces) for view in zip(frames, detections_per_frame, strict=True)]
    left_out = [replace(candidate, frame=i) for i, (_, rest) in enumerate(views) for candidate in rest]
    return _associated(frames, complete([found for found, _ in views]), surfaces, left_out)


def _associated(
    frames: Sequence[RgbdFrame],
    found: Sequence[Sequence[ObjectDetection]],
    surfaces: Sequence[SupportSurface],
    left_out: Sequence[LeftOut],
) -> Detections:
    """Associate the detections; without any object, add the things that no candidate covers."""
    rows, rejected = associate_on_surfaces(frames, found, surfaces)
    candidates = [*left_out, *rejected]
    if not any(rows):
        for i, frame in enumerate(frames):
            known = [candidate for candidate in candidates if candidate.frame == i]
            candidates += [replace(thing, frame=i) for thing in unrecognised(frame, surfaces, known)]
    return Detections(surfaces[0].plane, rows, tuple(surfaces), tuple(candidates))


def reconstruct_objects(
    frames: Sequence[RgbdFrame],
    detections: Detections,
    decoder: ShapeDecoder,
    progress: Progress = no_progress,
    on_step: OnFitStep | None = None,
    on_rejected: OnRejected | None = None,
    clutter: PoseNamer | None = None,
    starts: Sequence[ObjectEstimate] = (),
) -> list[ObjectEstimate]:
    """Estimate the complete shape and the pose of every detected object, ordered by id.

    Args:
        frames: Views with camera poses.
        detections: Associated detections of the same frames.
        decoder: Shape prior.
        progress: Called after each object with its name.
        on_step: Called after each Levenberg-Marquardt step with object id, class and step.
        on_rejected: Called with each object that is left out, because its fit failed or the evidence of the
            fit contradicts its class.
        clutter: Names the parts of stacks. With it, objects that rest in other poses than upright, or on
            others, are looked for among the candidates that the detector gave no class and in the objects
            that no single shape explains; None for the detections alone.
        starts: Estimates from fewer images, at which the fits of the same objects start.
    """
    options = ReconstructOptions(
        progress=progress, on_step=on_step, on_rejected=on_rejected, starts=starts,
        acceptance=shipped_acceptance(),
    )  # fmt: skip
    rows, left_out = detections.per_frame, detections.left_out
    if clutter is None:
        found = reconstruct(frames, rows, decoder, detections.planes, options=options)
        return _without_parts_of_things(found, frames, detections, on_rejected)
    from perception.clutter import reconstruct_clutter  # slow to import

    return reconstruct_clutter(frames, rows, left_out, decoder, detections.planes, clutter, options)


def _without_parts_of_things(
    objects: Sequence[ObjectEstimate],
    frames: Sequence[RgbdFrame],
    detections: Detections,
    on_rejected: OnRejected | None,
) -> list[ObjectEstimate]:
    """Return the objects without those which a single image shows to be parts of things of no class."""
    parts = parts_of_things_in_one_view(objects, frames, detections.per_frame, detections.planes)
    if on_rejected is not None:
        for e in objects:
            if e.id in parts:
                on_rejected(RejectedObject(e.id, e.category, SAME_COLOUR, e.score, is_part=True))
    return [e for e in objects if e.id not in parts]
