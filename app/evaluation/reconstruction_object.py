"""One object of ``evaluate reconstruction``: seen, reconstructed by every method, scored."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from app.options import Device, EvaluateOptions, Method
from app.task.scoring import TrueSurface
from app.training.crop_dataset import handle_share
from app.training.yaw import HANDLE_VISIBLE
from perception.detection.detector import Detector, DetectorConfig
from perception.errors import PerceptionError
from perception.inference.ablations import method_config, reconstruct_by
from perception.inference.fit import FitConfig, FitStep, fit_object
from perception.inference.meshing import EmptyShapeError, mesh_from_code
from perception.inference.reconstruct import gather_instances
from perception.metrics import SurfaceSamples, compare_surfaces
from perception.pipeline import load_decoder, resolve_device
from perception.shape.decoder import ShapeDecoder
from perception.support_plane import fit_support_plane
from perception.types import CATEGORIES, Category, ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

if TYPE_CHECKING:
    from sim_assets.objects import ObjectModel

CONVERGENCE_ITERATIONS = 150
PROTOCOL = FitConfig(start_views=1)  # the paper's: "initial object pose is predicted from the first view"


@dataclass(frozen=True)
class Subject:
    """An object to be judged on.

    Attributes:
        category: its class.
        index: its number in the class.
        path: its mesh file; None for an object of the test families.
        followed: whether its fits are watched over CONVERGENCE_ITERATIONS.
    """

    category: Category
    index: int
    path: Path | None = None
    followed: bool = False

    @property
    def name(self) -> str:
        return f"{self.category}_{self.index:03d}" + ("" if self.path is None else f"_{self.path.stem}")


@dataclass(frozen=True)
class Sight:
    """What perception gets to see of an object, and the truth that it is scored against.

    Attributes:
        frames, detections: the views; one in which nothing is found has no detection.
        truth: the object as it stands.
    """

    frames: tuple[RgbdFrame, ...]
    detections: tuple[tuple[ObjectDetection, ...], ...]
    truth: TrueSurface


def evaluate_subject(options: EvaluateOptions, subject: Subject) -> dict[str, Any]:
    """The line of results of one object: a row for each number of views and method."""
    sight = load_sight(options, subject)
    decoder = shared_decoder(options.device)
    visible = _handle_visible(sight)
    rows = []
    for views in options.views:
        for method in options.methods:
            begin = time.perf_counter()
            estimate = reconstruct_subject(sight, views, method, decoder)
            row: dict[str, Any] = {
                "object": subject.name,
                "category": subject.category,
                "views": views,
                "method": method,
                "found": estimate is not None,
                "seconds": round(time.perf_counter() - begin, 3),
            }
            if subject.category == "mug":
                row["handle_visible"] = any(visible[:views])
            if estimate is not None:
                row |= {"status": estimate.status, "residual": estimate.residual}
                row |= sight.truth.score(estimate, _rng(options, subject, 2))
            rows.append(row)
    line: dict[str, Any] = {"object": subject.name, "rows": rows}
    if subject.followed:
        line["convergence"] = _convergence(sight, options, subject, decoder)
    return line


def load_sight(options: EvaluateOptions, subject: Subject) -> Sight:
    """Draws the object, puts it on a table, takes the views and detects it in them."""
    from sim_assets.datasets.single_object import SingleObjectConfig, render_single_object

    model = _model(options, subject)
    config = SingleObjectConfig(depth_noise=options.depth_noise)
    portrait = render_single_object(model, max(options.views), _rng(options, subject, 1), config)
    detections = tuple(
        _known(_detector(options.device)(frame, fit_support_plane([frame])), subject.category)
        for frame in portrait.frames
    )
    truth = TrueSurface.of(model, portrait.T_world_object, _rng(options, subject, 3))
    return Sight(portrait.frames, detections, truth)


def _known(found: Sequence[ObjectDetection], category: Category) -> tuple[ObjectDetection, ...]:
    """What is found in one image as a detection of the one object there, whose class is known.

    A rim before its own far side may part an object into two instances; all that look like the class are
    joined.
    """
    like = [detection.class_probabilities[CATEGORIES.index(category)] for detection in found]
    if not found:
        return ()
    best = int(np.argmax(like))
    parts = [detection.mask for detection, p in zip(found, like) if p > 0.5] or [found[best].mask]
    mask = np.logical_or.reduce(parts)
    return (replace(found[best], category=category, instance_id=0, mask=mask),)


def reconstruct_subject(
    sight: Sight, views: int, method: Method, decoder: ShapeDecoder
) -> ObjectEstimate | None:
    """The object from its first views by one method; None where nothing of it was found."""
    frames, detections = sight.frames[:views], sight.detections[:views]
    plane = fit_support_plane(frames)
    estimates = reconstruct_by(method, frames, detections, decoder, plane, PROTOCOL)
    return estimates[0] if estimates else None


def _model(options: EvaluateOptions, subject: Subject) -> ObjectModel:
    if subject.path is None:
        from sim_assets.objects import sample_object

        return sample_object(subject.category, "test", _rng(options, subject, 0))
    from sim_assets.objects import load_user_object

    return load_user_object(subject.path, subject.category, collision=False)


def _rng(options: EvaluateOptions, subject: Subject, purpose: int) -> np.random.Generator:
    """Independent streams, so that an object does not depend on how many there are or who comes before."""
    key = [options.seed, CATEGORIES.index(subject.category), subject.index, purpose]
    return np.random.default_rng(np.random.SeedSequence(key))


def _handle_visible(sight: Sight) -> list[bool]:
    """For each view, whether enough of what it shows of a mug is its handle."""
    T = sight.truth.T_world_object
    clouds = [_cloud(frame, found) for frame, found in zip(sight.frames, sight.detections)]
    return [handle_share(points, T) >= HANDLE_VISIBLE for points in clouds]


def _cloud(frame: RgbdFrame, found: Sequence[ObjectDetection]) -> Float[np.ndarray, "n 3"]:
    from perception.fusion.tsdf import masked_cloud

    return masked_cloud(frame, found[0].mask) if found else np.zeros((0, 3))


def _convergence(
    sight: Sight, options: EvaluateOptions, subject: Subject, decoder: ShapeDecoder
) -> dict[str, list[tuple[int, float | None]]]:
    """Chamfer-L1 [m] over the iterations, from one view, by method."""
    curves: dict[str, list[tuple[int, float | None]]] = {}
    for method in options.methods:
        if method in ("tsdf", "no_refinement") or not sight.detections[0]:  # no fit, or the same as full
            continue
        curve: list[tuple[int, float | None]] = []

        def follow(step: FitStep, curve: list[tuple[int, float | None]] = curve) -> None:
            curve.append((step.iteration, _chamfer(step, subject, sight, decoder)))

        config = method_config(method, PROTOCOL)
        *first, last = config.stages
        rest = CONVERGENCE_ITERATIONS - sum(stage.iterations for stage in first)
        config = replace(config, stages=(*first, replace(last, iterations=rest)))
        plane: SupportPlane = fit_support_plane(sight.frames[:1])
        (views,) = gather_instances(sight.frames[:1], sight.detections[:1])
        try:
            fit_object(views, decoder, plane, config, follow)
        except PerceptionError:
            continue
        curves[method] = curve
    return curves


def _chamfer(step: FitStep, subject: Subject, sight: Sight, decoder: ShapeDecoder) -> float | None:
    try:
        mesh = mesh_from_code(decoder, subject.category, step.code.astype(np.float32), step.pose.scale)
    except EmptyShapeError:
        return None
    samples = SurfaceSamples.of(mesh.transformed(step.pose.T_world_object), np.random.default_rng(0), 3000)
    return compare_surfaces(samples, sight.truth.sparse).chamfer_l1


@cache
def shared_decoder(device: Device) -> ShapeDecoder:
    """Networks, loaded once in each process."""
    return load_decoder(device)


@cache
def _detector(device: Device) -> Detector:
    """It says where the object is and which way its handle points; its class is known."""
    return Detector.load(resolve_device(device), config=DetectorConfig(max_other=1.0, min_mug=0.0))
