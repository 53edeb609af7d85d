"""Scores of an episode against ground truth; the only reader of ``sim_assets.cell.ground_truth``.

The pipeline must not import this module. The oracle estimates of ``--shapes oracle``, which isolate planning
from perception, are made here as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from app.runs.report import ObjectReport
from app.task.criteria import BoxSpace, TrueObject, judge_pack, judge_sort
from manipulation.types import Line, ObjectOutcome, TaskPlan
from perception.inference.resting import resting_pose
from perception.metrics import SurfaceSamples, compare_surfaces, point_recall
from perception.types import CODE_SIZE, ObjectEstimate, SupportPlane, TriangleMesh
from sim_assets.cell import ground_truth
from sim_assets.cell.scene import BoxConfig
from sim_assets.cell.world import World
from sim_assets.objects import ObjectModel, canonical_scale

UNMOVED = (0.005, float(np.deg2rad(10)))  # [m], [rad]: how far things of no class may move
TOPPLED = float(np.deg2rad(30))  # [rad]
STACKED = 0.003  # [m] height of the lowest part of an object on another one, at least
MATCH_DISTANCE = 0.05  # [m] between the axes of an estimate and its true object


@dataclass(frozen=True)
class Truth:
    """True models and poses of all objects in the cell at one time, by object number.

    Attributes:
        models: models of the objects.
        poses: T_world_object.
        unknown: T_world_thing of the things of no class, by their number.
    """

    models: Mapping[int, ObjectModel]
    poses: Mapping[int, Float[np.ndarray, "4 4"]]
    unknown: Mapping[int, Float[np.ndarray, "4 4"]] = field(default_factory=dict)

    @property
    def objects(self) -> dict[int, TrueObject]:
        """Shapes and poses; what stands on its top, and whose ends are alike, counts as upright."""
        return {
            i: TrueObject(
                category=m.category,
                vertices=np.asarray(m.mesh.vertices),
                faces=np.asarray(m.mesh.faces),
                height=m.height,
                radius=m.radius,
                T_world_object=self.poses[i],
            ).on_like_end()
            for i, m in self.models.items()
        }


def read_truth(world: World) -> Truth:
    """Read the present true state."""
    return Truth(
        ground_truth.object_models(world), ground_truth.object_poses(world), ground_truth.unknown_poses(world)
    )


def unknown_moves(before: Truth, after: Truth) -> list[dict[str, Any]]:
    """Return for each thing of no class its shift [m], its turn and its tilt [rad], and what they amount to.

    It was moved if shift or turn exceed UNMOVED, and toppled if its vertical tilted by more than TOPPLED.
    """
    rows = []
    for number, T_before in before.unknown.items():
        T = np.linalg.inv(T_before) @ after.unknown[number]
        shift = float(np.linalg.norm(T[:3, 3]))
        turn = float(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
        upright = T_before[2, :3]  # the vertical in the frame of the thing
        tilt = float(np.arccos(np.clip(after.unknown[number][2, :3] @ upright, -1, 1)))
        moved = shift > UNMOVED[0] or turn > UNMOVED[1]
        rows.append({"shift": shift, "turn": turn, "tilt": tilt, "moved": moved, "toppled": tilt > TOPPLED})
    return rows


def oracle_estimates(truth: Truth) -> list[ObjectEstimate]:
    """Return the estimates of a perfect perception."""
    estimates = []
    for number, model in truth.models.items():
        scale, centre = canonical_scale(model)
        T_true_object = np.eye(4)
        T_true_object[:3, 3] = centre
        mesh = TriangleMesh(np.asarray(model.mesh.vertices) - centre, np.asarray(model.mesh.faces))
        estimates.append(
            ObjectEstimate(
                id=number,
                category=model.category,
                code=np.zeros(CODE_SIZE),
                T_world_object=truth.poses[number] @ T_true_object,
                scale=np.full(3, scale),
                mesh=mesh,
            )
        )
    return estimates


def match(estimates: Sequence[ObjectEstimate], truth: Truth) -> dict[int, int]:
    """Assign estimates to true objects, so that the sum of the chamfer-L1 of their surfaces is smallest.

    They match only if the middles of their bodies' axes are at most MATCH_DISTANCE apart horizontally. Return
    object numbers by estimate id.
    """
    if not estimates or not truth.models:
        return {}
    numbers = list(truth.models)
    halves = [(0.0, 0.0, truth.models[number].height / 2, 1.0) for number in numbers]
    there = np.array([(truth.poses[number] @ half)[:3] for number, half in zip(numbers, halves)])
    middles = np.array([_axis(estimate) for estimate in estimates])
    apart = np.linalg.norm((middles[:, None] - there)[..., :2], axis=-1)
    found = [_few_samples(estimate.mesh_world) for estimate in estimates]
    true = [_few_samples(_true_mesh(truth.models[n], truth.poses[n])) for n in numbers]
    cost = np.full(apart.shape, 1.0)  # [m], more than between two surfaces whose axes are near
    for row, column in np.argwhere(apart <= MATCH_DISTANCE):
        cost[row, column] = compare_surfaces(found[row], true[column]).chamfer_l1
    rows, columns = linear_sum_assignment(cost)
    return {
        estimates[row].id: numbers[column]
        for row, column in zip(rows, columns)
        if apart[row, column] <= MATCH_DISTANCE
    }


def _few_samples(mesh: TriangleMesh) -> SurfaceSamples:
    """Return enough samples to tell which of two surfaces is nearer, the same ones each time."""
    return SurfaceSamples.of(mesh, np.random.default_rng(0), 1000)


def _true_mesh(model: ObjectModel, T_world_object: Float[np.ndarray, "4 4"]) -> TriangleMesh:
    """Return the surface of a model in the world frame [m]."""
    mesh = TriangleMesh(np.asarray(model.mesh.vertices), np.asarray(model.mesh.faces))
    return mesh.transformed(T_world_object)


def _axis(estimate: ObjectEstimate) -> Float[np.ndarray, "3"]:
    """Return the middle of the body's axis in the world frame, without a mug's handle [m]."""
    low, high = estimate.mesh.vertices.min(axis=0), estimate.mesh.vertices.max(axis=0)
    _, y, z = (low + high) / 2
    x = low[0] + estimate.radius if estimate.category == "mug" else (low[0] + high[0]) / 2
    return (estimate.T_world_object @ (x, y, z, 1.0))[:3]


def score_reconstruction(
    estimates: Sequence[ObjectEstimate], truth: Truth, rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Return one row per true object: how it rests, and how it was estimated.

    ``resting`` is its true pose, ``stacked`` whether it is on another object, ``axis_error`` [rad] the angle
    between true and estimated axis (a can has no direction); accuracy, chamfer_l1 [m], completion at 1 cm,
    handle recall at 5 mm.
    """
    matches = {number: estimate_id for estimate_id, number in match(estimates, truth).items()}
    by_id = {estimate.id: estimate for estimate in estimates}
    rows = []
    for number, model in truth.models.items():
        pose = truth.poses[number]
        lowest = float((model.mesh.vertices @ pose[:3, :3].T + pose[:3, 3])[:, 2].min())
        row: dict[str, Any] = {
            "object": number,
            "category": model.category,
            "resting": resting_pose(pose[:3, :3], SupportPlane()),
            "stacked": lowest > STACKED,
            "found": number in matches,
        }
        if number in matches:
            estimate = by_id[matches[number]]
            row |= {"id": estimate.id, "perceived": estimate.category, "status": estimate.status}
            row["axis_error"] = _axis_error(estimate, pose, model.category)
            row |= TrueSurface.of(model, pose, rng).score(estimate, rng)
        rows.append(row)
    return rows


def _axis_error(estimate: ObjectEstimate, T_world_object: Float[np.ndarray, "4 4"], category: str) -> float:
    """Return the angle between an estimated and a true axis [rad]; cans look alike from both ends."""
    cosine = float(np.clip(estimate.T_world_object[:3, 2] @ T_world_object[:3, 2], -1, 1))
    return float(np.arccos(abs(cosine) if category == "can" else cosine))


@dataclass(frozen=True)
class TrueSurface:
    """Sampled true surface of an object, as the reference of its reconstructions.

    Attributes:
        T_world_object: True pose.
        mesh_world: Surface in the world frame, in metres.
        samples: Samples of the surface in the world frame.
        handle: Those of the samples on a mug's handle, in metres.
    """

    T_world_object: Float[np.ndarray, "4 4"]
    mesh_world: TriangleMesh
    samples: SurfaceSamples
    handle: Float[np.ndarray, "m 3"]

    @staticmethod
    def of(
        model: ObjectModel, T_world_object: Float[np.ndarray, "4 4"], rng: np.random.Generator
    ) -> TrueSurface:
        mesh = _true_mesh(model, T_world_object)
        samples = SurfaceSamples.of(mesh, rng)
        local = (samples.points - T_world_object[:3, 3]) @ T_world_object[:3, :3]
        return TrueSurface(T_world_object, mesh, samples, samples.points[model.is_handle(local)])

    @cached_property
    def sparse(self) -> SurfaceSamples:
        """Every sixth sample, for curves over time."""
        return SurfaceSamples(self.samples.points[::6], self.samples.normals[::6], self.samples.faces[::6])

    def score(self, estimate: ObjectEstimate, rng: np.random.Generator) -> dict[str, float]:
        """Return accuracy and chamfer_l1 [m], completion at 1 cm, and for mugs the handle's recall at 5 mm.

        For an estimate with ``surface_sigma`` also return its median [m] and the shares of the surface whose
        error is below one and two standard deviations.
        """
        samples = SurfaceSamples.of(estimate.mesh_world, rng)
        figures = compare_surfaces(samples, self.samples)
        result = {name: float(getattr(figures, name)) for name in ("accuracy", "chamfer_l1", "completion")}
        if estimate.surface_sigma is not None:
            sigma = estimate.surface_sigma[estimate.mesh.faces[samples.faces]].mean(axis=1)
            error = self.samples.distance_along_normal(samples.points)
            result["surface_sigma"] = float(np.median(sigma))
            result |= {f"within_{k}_sigma": float((error < k * sigma).mean()) for k in (1, 2)}
        if len(self.handle):
            result["handle_recall"] = point_recall(samples, self.handle)
        return result


def score_task(
    plan: TaskPlan | None,
    estimates: Sequence[ObjectEstimate],
    outcomes: Sequence[ObjectOutcome],
    before: Truth,
    after: Truth,
    box: BoxConfig | None,
) -> list[ObjectReport]:
    """Return the report of every object in the cell, perceived or not.

    Args:
        plan: Task plan; None if planning failed.
        estimates: Object map from which the plan was made.
        outcomes: Outcomes as reported by execution; they never count as success.
        before, after: True states before the first and after the last motion.
        box: Box of a packing task; None for sorting.
    """
    objects = after.objects
    if box is not None:
        space = BoxSpace(box.center, box.inner[:2], box.floor)
        verdicts = judge_pack(list(objects.values()), space)
    else:
        lines = (plan.lines if plan else ()) or (Line(),)
        verdicts = judge_sort(list(objects.values()), [(line.start, line.end) for line in lines])
    judged = dict(zip(objects, verdicts))
    estimate_of = {number: estimate_id for estimate_id, number in match(estimates, before).items()}
    by_id = {estimate.id: estimate for estimate in estimates}
    outcome_of = {outcome.id: outcome for outcome in outcomes}
    reports = []
    for number, item in objects.items():
        estimate = by_id.get(estimate_of.get(number, -1))
        outcome = outcome_of.get(estimate.id) if estimate else None
        reason = judged[number]
        if reason:
            reason = _why(reason, plan, estimate, outcome)
        reports.append(
            ObjectReport(
                id=estimate.id if estimate else -1 - number,
                category=item.category,
                placed=not reason,
                error_position=_distance(item, outcome),
                error_tilt=item.tilt,
                attempts=outcome.attempts if outcome else 0,
                reason=reason,
                details={"perceived": estimate.category if estimate else None, "size": item.size},
            )
        )
    return reports


def _why(
    judged: str, plan: TaskPlan | None, estimate: ObjectEstimate | None, outcome: ObjectOutcome | None
) -> str:
    """Return the first failure: perception, planning, execution, or the verdict of the criteria."""
    if estimate is None:
        return f"not perceived ({judged})"
    if plan is None:
        return "no plan"
    if estimate.name in plan.left_out:
        return f"not attempted: {plan.left_out[estimate.name]}"
    if outcome is not None and not outcome.placed:
        return outcome.reason or judged
    return judged


def _distance(item: TrueObject, outcome: ObjectOutcome | None) -> float | None:
    """Return the horizontal distance between the object and its goal, in metres."""
    if outcome is None or outcome.T_world_stand is None:
        return None
    return float(np.linalg.norm((item.base - outcome.T_world_stand[:3, 3])[:2]))
