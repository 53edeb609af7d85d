"""One episode of a task in the simulated cell: run the pipeline, then score it from the true state."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from app.options import Task, TaskOptions
from app.runs.report import ObjectReport, Report
from app.task.pipeline import Goal, Outcome, Shapes, Watcher
from app.task.pipeline import run as run_pipeline
from app.task.scoring import Truth, oracle_estimates, read_truth, score_reconstruction, score_task
from manipulation.types import Box
from perception.pipeline import Detections, Perception
from perception.types import ObjectEstimate, RgbdFrame
from sim_assets.cell.scene import BoxConfig
from sim_assets.cell.world import World

# What the robot itself calls in place when it looks again: this upright [rad] and this near its goal [m].
MAX_TILT, MAX_SHIFT = np.deg2rad(10), 0.03
NOT_SETTINGS = {"seed", "out", "quiet", "json"}


def run_episode(
    world: World,
    options: TaskOptions,
    task: Task,
    perception: Perception,
    watcher: Watcher | None = None,
) -> tuple[Report, Outcome]:
    """Carry the task out in the cell and score it.

    Returns:
        The report, and what the stages made.
    """
    begin, simulated_begin = time.perf_counter(), world.time
    before = read_truth(world)
    box = world.config.box if task == "pack" else None
    goal = Goal(task, _planned_box(box), shapes=_shapes(options, before))
    outcome = run_pipeline(world, perception, goal, watcher)
    seconds, simulated = time.perf_counter() - begin, world.time - simulated_begin
    after = read_truth(world)
    objects = score_task(outcome.plan, outcome.objects, outcome.outcomes, before, after, box)
    objects = [_with_check(entry, outcome) for entry in objects]
    rows = score_reconstruction(outcome.objects, before, np.random.default_rng(options.seed))
    n_placed = sum(bool(entry.placed) for entry in objects)
    report = Report(
        command=task,
        seed=options.seed,
        success=n_placed == len(objects),
        reason=_reason(objects, outcome),
        timings=outcome.timings | {"total": seconds},
        objects=objects,
        metrics={
            "n_objects": len(objects),
            "n_perceived": len(outcome.objects),
            "n_placed": n_placed,
            "simulated_seconds": simulated,
            "reconstruction": rows,
        },
        settings=settings_of(options),
    )
    return report, outcome


def settings_of(options: TaskOptions) -> dict[str, Any]:
    """The options that decide what an episode is."""
    names = {field.name for field in fields(TaskOptions)} - NOT_SETTINGS
    return {name: getattr(options, name) for name in sorted(names)}


def _planned_box(box: BoxConfig | None) -> Box | None:
    """The box as the planner knows it: the cell's drawing, not its state."""
    return box and Box(center=box.center, size=box.inner, floor=box.floor, wall=box.wall)


def _shapes(options: TaskOptions, before: Truth) -> Shapes | None:
    """Another source of shapes where the options ask for one."""
    if options.shapes == "oracle":
        return lambda frames, detections: oracle_estimates(before)
    if options.shapes == "tsdf":
        return _tsdf
    return None


def _tsdf(frames: Sequence[RgbdFrame], detections: Detections) -> list[ObjectEstimate]:
    from perception.fusion.tsdf import reconstruct_tsdf

    return reconstruct_tsdf(frames, detections.per_frame, detections.plane)


def _with_check(entry: ObjectReport, outcome: Outcome) -> ObjectReport:
    """The entry with what the robot itself saw when it looked again."""
    check = outcome.checks.get(entry.id)
    if check is None:
        return entry
    in_place = check.status == "seen" and check.tilt < MAX_TILT and check.shift < MAX_SHIFT
    seen = {
        "seen": check.status,
        "seen_in_place": in_place,
        "seen_shift": check.shift,
        "seen_tilt": check.tilt,
        "seen_inlier_share": check.inlier_share,
    }
    return replace(entry, details={**entry.details, **seen})


def _reason(objects: Sequence[ObjectReport], outcome: Outcome) -> str:
    """One line that says how it went."""
    n_placed = sum(bool(entry.placed) for entry in objects)
    summary = f"{n_placed} of {len(objects)} objects in place"
    if outcome.problem:
        return f"{summary}; {outcome.problem}"
    wrong = [f"{entry.category} {entry.id}: {entry.reason}" for entry in objects if not entry.placed]
    return f"{summary}; {'; '.join(wrong)}" if wrong else summary
