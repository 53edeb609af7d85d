"""Scores of a SLAM run against ground truth: trajectory error, surface errors, completion by update.

Trajectories are not aligned to the truth: the first pose is given, so errors are absolute.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from app.errors import MissingExtraError
from app.slam.run import SlamRun
from perception.errors import install_hint
from perception.fusion.tsdf import TsdfConfig, reconstruct_tsdf
from perception.inference.meshing import EmptyShapeError
from perception.inference.shape_model import Decoder
from perception.io.recordings.trajectory import Trajectory
from perception.metrics import SurfaceSamples, compare_surfaces
from perception.slam.estimates import object_estimate
from perception.slam.keyframes import Keyframe
from perception.slam.landmarks import Landmark
from perception.types import ObjectDetection, SupportPlane, TriangleMesh

MATCH_DISTANCE = 0.06  # [m] between the centres of an estimate and of its true object
CURVE_SAMPLES = 4000
CURVE_UPDATES = 8


def absolute_pose_error(found: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Return ``ape_mean``, ``ape_rmse`` and ``ape_max`` of the camera position [m] by evo, without alignment.

    Raises:
        MissingExtraError: evo is not installed.
    """
    try:
        from evo.core import metrics, sync
        from evo.core.trajectory import PoseTrajectory3D
    except ImportError:
        raise MissingExtraError(f"trajectory errors need evo: {install_hint('eval')}") from None
    reference, estimate = (
        PoseTrajectory3D(timestamps=t.times, poses_se3=list(t.Ts_world_camera)) for t in (truth, found)
    )
    pair = sync.associate_trajectories(reference, estimate, max_diff=1e-3)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(pair)
    statistics = ape.get_all_statistics()
    return {f"ape_{name}": float(statistics[name]) for name in ("mean", "rmse", "max")}


class TrueObjects:
    """Sampled true surfaces of a scene."""

    def __init__(self, objects: Sequence[tuple[str, TriangleMesh]], rng: np.random.Generator) -> None:
        self.categories = [category for category, _ in objects]
        self.samples = [SurfaceSamples.of(mesh, rng) for _, mesh in objects]
        self.sparse = [SurfaceSamples.of(mesh, rng, CURVE_SAMPLES) for _, mesh in objects]
        self.centres = np.array([centre_of(mesh.vertices) for _, mesh in objects])

    def match(self, places: Mapping[int, Float[np.ndarray, "3"]]) -> dict[int, int]:
        """Return the index of the true object of each landmark id, by position."""
        return match_places(places, self.centres)


def match_places(
    places: Mapping[int, Float[np.ndarray, "3"]], centres: Float[np.ndarray, "n 3"]
) -> dict[int, int]:
    """Return the index of the true object of each landmark id: one to one, within ``MATCH_DISTANCE``."""
    if not places:
        return {}
    ids = list(places)
    distance = np.linalg.norm(np.array(list(places.values()))[:, None] - centres, axis=-1)
    rows, columns = linear_sum_assignment(np.minimum(distance, 2 * MATCH_DISTANCE))
    return {ids[r]: int(c) for r, c in zip(rows, columns) if distance[r, c] < MATCH_DISTANCE}


def places_of(landmarks: Sequence[Landmark]) -> dict[int, Float[np.ndarray, "3"]]:
    """Return the landmarks' origins by id, in metres."""
    return {landmark.id: landmark.state.pose.translation for landmark in landmarks}


def centre_of(vertices: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Return the centre of the bounding box."""
    return (vertices.min(axis=0) + vertices.max(axis=0)) / 2


def surface_rows(
    landmarks: Sequence[Landmark], truth: TrueObjects, decoder: Decoder, rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Return class, accuracy [m], chamfer_l1 [m] and completion at 1 cm of each landmark, if it matches."""
    matches = truth.match(places_of(landmarks))
    rows = []
    for landmark in landmarks:
        row: dict[str, Any] = {
            "id": landmark.id,
            "category": landmark.category,
            "updates": landmark.n_updates,
            "hits": landmark.n_hits,
        }
        index = matches.get(landmark.id)
        if index is None:
            rows.append(row | {"true_category": None})
            continue
        row |= {"true_category": truth.categories[index], "true_index": index}
        try:
            mesh = object_estimate(landmark, decoder).mesh_world
        except EmptyShapeError:
            rows.append(row)
            continue
        figures = compare_surfaces(SurfaceSamples.of(mesh, rng), truth.samples[index])
        rows.append(row | {k: float(getattr(figures, k)) for k in ("accuracy", "chamfer_l1", "completion")})
    return rows


def completion_by_update(
    history: Mapping[int, list[Landmark]], truth: TrueObjects, decoder: Decoder, rng: np.random.Generator
) -> list[list[float]]:
    """Return for each object of the final map its completion after the first, second, ... update."""
    matches = truth.match(places_of([states[-1] for states in history.values()]))
    curves = []
    for id, index in matches.items():
        curve = []
        for state in history[id][:CURVE_UPDATES]:
            try:
                samples = SurfaceSamples.of(object_estimate(state, decoder).mesh_world, rng, CURVE_SAMPLES)
                curve.append(compare_surfaces(samples, truth.sparse[index]).completion)
            except EmptyShapeError:
                curve.append(0.0)
        curves.append(curve)
    return curves


def fused_by_update(
    run: SlamRun,
    Ts_given: dict[int, Float[np.ndarray, "4 4"]],
    truth: TrueObjects,
    plane: SupportPlane,
    rng: np.random.Generator,
) -> dict[str, list[list[float]]]:
    """Score TSDF fusion (Fusion++) of the keyframes that observe each object, at given poses.

    Returns:
        ``completion`` and ``accuracy`` [m] of each object of the map after 1, 2, ... keyframes.
    """
    assert run.slam.world is not None
    landmarks = [run.slam.world.landmarks[id] for id in run.slam.world.ids]
    curves: dict[str, list[list[float]]] = {"completion": [], "accuracy": []}
    for id, index in truth.match(places_of(landmarks)).items():
        views = [k for k in run.slam.keyframes if id in k.landmark_ids and k.number in Ts_given]
        completion, accuracy = [], []
        for count in range(1, min(len(views), CURVE_UPDATES) + 1):
            frames = [replace(k.frame, T_world_camera=Ts_given[k.number]) for k in views[:count]]
            masks = [[_detection(k, id)] for k in views[:count]]
            fused = reconstruct_tsdf(frames, masks, plane, TsdfConfig(closed=False))
            if not fused:
                completion.append(0.0)
                continue
            samples = SurfaceSamples.of(fused[0].mesh_world, rng, CURVE_SAMPLES)
            figures = compare_surfaces(samples, truth.sparse[index])
            completion.append(figures.completion)
            accuracy.append(figures.accuracy)
        curves["completion"].append(completion)
        curves["accuracy"].append(accuracy)
    return curves


def _detection(key: Keyframe, id: int) -> ObjectDetection:
    return ObjectDetection("mug", 1.0, key.mask(id), instance_id=id)  # fusion ignores the class
