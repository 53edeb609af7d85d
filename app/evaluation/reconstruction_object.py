"""One object of ``evaluate reconstruction``: rendered, detected, reconstructed by every method, scored."""

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
from perception.detection.completion import complete_detections
from perception.detection.detector import Detector, DetectorConfig
from perception.errors import PerceptionError
from perception.inference.ablations import method_config, reconstruct_by
from perception.inference.acceptance import shipped_acceptance
from perception.inference.fit import fit_object
from perception.inference.fit_config import FitConfig
from perception.inference.meshing import EmptyShapeError, mesh_from_code
from perception.inference.optimisation import FitStep
from perception.inference.reconstruct import ReconstructOptions, gather_instances, reconstruct
from perception.metrics import SurfaceSamples, compare_surfaces
from perception.pipeline import load_decoder, resolve_device
from perception.shape.decoder import ShapeDecoder
from perception.support_plane import fit_support_plane
from perception.types import (
    CATEGORIES,
    Category,
    ObjectDetection,
    ObjectEstimate,
    RestingPose,
    RgbdFrame,
    SupportPlane,
    unclassified,
)

if TYPE_CHECKING:
    from sim_assets.objects import ObjectModel

CONVERGENCE_ITERATIONS = 150
MOST_SUBJECTS = 10_000  # of one class
MOST_DRAWS = 20  # objects that are tried in a resting pose
PROTOCOL = FitConfig(start_views=1)  # paper: "initial object pose is predicted from the first view"


@dataclass(frozen=True)
class Subject:
    """Object to evaluate.

    Attributes:
        category: Class.
        index: Number within the class.
        path: Mesh file; None for an object of the test families.
        followed: Whether the error is recorded over CONVERGENCE_ITERATIONS iterations.
        resting: Resting pose.
    """

    category: Category
    index: int
    path: Path | None = None
    followed: bool = False
    resting: RestingPose = "upright"

    @property
    def name(self) -> str:
        stem = "" if self.path is None else f"_{self.path.stem}"
        return f"{self.category}_{self.index:03d}{stem}" + (
            "" if self.resting == "upright" else f"_{self.resting}"
        )


@dataclass(frozen=True)
class Sight:
    """Images of an object, and its ground truth.

    Attributes:
        frames: RGB-D images with camera poses.
        detections: For each image its detection; empty where the object is not detected.
        truth: True surface at the true pose.
        any_pose: Whether resting poses are compared; objects are taken for upright if not.
    """

    frames: tuple[RgbdFrame, ...]
    detections: tuple[tuple[ObjectDetection, ...], ...]
    truth: TrueSurface
    any_pose: bool = False


def evaluate_subject(options: EvaluateOptions, subject: Subject) -> dict[str, Any]:
    """Return the results of one object: a row for each number of views and method."""
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
                "resting": subject.resting,
                "views": views,
                "method": method,
                "found": estimate is not None,
                "seconds": round(time.perf_counter() - begin, 3),
            }
            if subject.category == "mug":
                row["handle_visible"] = any(visible[:views])
            if estimate is not None:
                row |= {"status": estimate.status, "residual": estimate.residual}
                row |= {"perceived": estimate.category, "estimated": estimate.resting}
                row |= sight.truth.score(estimate, _rng(options, subject, 2))
            rows.append(row)
    line: dict[str, Any] = {"object": subject.name, "rows": rows}
    if subject.followed:
        line["convergence"] = _convergence(sight, options, subject, decoder)
    return line


def load_sight(options: EvaluateOptions, subject: Subject) -> Sight:
    """Sample the object, render it on a table and detect it in each view.

    Where resting poses are compared, detected masks come without a class.
    """
    from sim_assets.datasets.single_object import SingleObjectConfig, render_single_object

    model, T_rest = _at_rest(options, subject)
    any_pose = set(options.poses) != {"upright"}
    config = SingleObjectConfig(depth_noise=options.depth_noise)
    portrait = render_single_object(model, max(options.views), _rng(options, subject, 1), config, T_rest)
    detector = _detector(options.device)
    if options.masks == "given":
        given = [
            [ObjectDetection(subject.category, 1.0, mask, instance_id=0)] if mask.any() else []
            for mask in portrait.masks
        ]
        detections = complete_detections(
            portrait.frames, given, [fit_support_plane(portrait.frames)], detector
        )
    else:
        detections = tuple(
            _merged(detector(frame, fit_support_plane([frame])), subject.category)
            for frame in portrait.frames
        )
        if any_pose:
            detections = tuple(tuple(unclassified(d.mask, 0) for d in found) for found in detections)
    truth = TrueSurface.of(model, portrait.T_world_object, _rng(options, subject, 3))
    return Sight(portrait.frames, detections, truth, any_pose)


def _merged(found: Sequence[ObjectDetection], category: Category) -> tuple[ObjectDetection, ...]:
    """Return the detections of an image merged to one of the known class; empty without detections.

    A rim in front of the far side may split an object into two instances: all that are probably of the class
    are merged, or the most probable one is kept.
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
    """Reconstruct the object from its first views by one method; None where it is not detected."""
    frames, detections = sight.frames[:views], sight.detections[:views]
    plane = fit_support_plane(frames)
    if sight.any_pose and method == "full":
        compared = ReconstructOptions(workers=1, acceptance=shipped_acceptance())
        estimates = reconstruct(frames, detections, decoder, plane, PROTOCOL, compared)
        return estimates[0] if estimates else None
    estimates = reconstruct_by(method, frames, detections, decoder, plane, PROTOCOL)
    return estimates[0] if estimates else None


def _model(options: EvaluateOptions, subject: Subject) -> ObjectModel:
    if subject.path is None:
        from sim_assets.objects import sample_object

        return sample_object(subject.category, "test", _rng(options, subject, 0))
    from sim_assets.objects import load_user_object

    return load_user_object(subject.path, subject.category, collision=False)


def _at_rest(
    options: EvaluateOptions, subject: Subject
) -> tuple[ObjectModel, Float[np.ndarray, "4 4"] | None]:
    """Return a model and its pose at rest, None for upright: the first draw that rests in the pose.

    Raises:
        LayoutError: The mesh, or none of the draws, rests that way.
    """
    from sim_assets.cell.arrangement import Arrangement, arrange
    from sim_assets.cell.layout import LayoutError

    if subject.resting == "upright":
        return _model(options, subject), None
    rng = _rng(options, subject, 4)
    wanted = Arrangement(
        lying=int(subject.resting == "lying"), upside_down=int(subject.resting == "upside-down")
    )
    for draw in range(MOST_DRAWS if subject.path is None else 1):
        model = _model(options, replace(subject, index=subject.index + draw * MOST_SUBJECTS))
        try:
            (group,) = arrange([model], wanted, rng)
        except LayoutError:
            continue
        return model, group.Ts_group_object[0]
    raise LayoutError(f"no {subject.category} rests {subject.resting}")


def _rng(options: EvaluateOptions, subject: Subject, purpose: int) -> np.random.Generator:
    """Return a random stream of one object and purpose, independent of the other objects."""
    key = [options.seed, CATEGORIES.index(subject.category), subject.index, purpose]
    return np.random.default_rng(np.random.SeedSequence(key))


def _handle_visible(sight: Sight) -> list[bool]:
    """Return for each view whether the handle of a mug is visible."""
    T = sight.truth.T_world_object
    clouds = [_cloud(frame, found) for frame, found in zip(sight.frames, sight.detections)]
    return [handle_share(points, T) >= HANDLE_VISIBLE for points in clouds]


def _cloud(frame: RgbdFrame, found: Sequence[ObjectDetection]) -> Float[np.ndarray, "n 3"]:
    from perception.fusion.tsdf import masked_cloud

    return masked_cloud(frame, found[0].mask) if found else np.zeros((0, 3))


def _convergence(
    sight: Sight, options: EvaluateOptions, subject: Subject, decoder: ShapeDecoder
) -> dict[str, list[tuple[int, float | None]]]:
    """Return (iteration, chamfer-L1 in metres) from one view by method; None where there is no surface."""
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
    """Return the decoder, loaded once in each process."""
    return load_decoder(device)


@cache
def _detector(device: Device) -> Detector:
    """Return the detector, without rejection of distractors or unlikely mugs: the class is known."""
    return Detector.load(resolve_device(device), config=DetectorConfig(max_other=1.0, min_mug=0.0))
