"""One episode of a task in the simulated cell: run the pipeline, then score it against ground truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np

from app.options import NOT_SETTINGS, Task, TaskOptions
from app.runs.report import ObjectReport, Report, moved_things
from app.task.arm_cell import cell_remarks
from app.task.faults import faulty_robot, judge_fault
from app.task.obstacles import obstacle_note, obstacle_rows
from app.task.pipeline import run as run_pipeline
from app.task.restricted_robot import restricted
from app.task.run_observer import RunObserver
from app.task.scoring import (
    Truth,
    oracle_estimates,
    read_truth,
    score_reconstruction,
    score_task,
    unknown_moves,
)
from app.task.task_types import Reconstruction, TaskRequest, TaskResult
from manipulation.types import Box, Line
from manipulation.workspace import Workspace
from perception.inference.refit import PoseCheck
from perception.pipeline import Detections, Perception
from perception.types import ObjectEstimate, RgbdFrame
from sim_assets.cell.scene import BoxConfig
from sim_assets.cell.world import World
from sim_assets.robots import PANDA

# Tolerances of the robot's own verification, reported beside the score: tilt [rad], distance to the goal [m].
MAX_TILT, MAX_SHIFT = float(np.deg2rad(10)), 0.03


def run_episode(
    world: World,
    options: TaskOptions,
    task: Task,
    perception: Perception,
    observer: RunObserver | None = None,
    perceive_only: bool = False,
) -> tuple[Report, TaskResult]:
    """Run a task in the cell and score it; with ``perceive_only`` up to the object map.

    The pipeline receives the cell as a restricted robot. Ground truth is read before and after it runs; with
    ``--shapes oracle`` alone, the pipeline is given the true state instead of estimates.
    """
    observer = observer or RunObserver()
    begin, paused, simulated_begin = time.perf_counter(), observer.paused_seconds, world.time
    before = read_truth(world)
    request = replace(request_of(world, task, options), perceive_only=perceive_only)
    remarks = [] if options.robot == PANDA else list(cell_remarks(world))
    for remark in remarks:
        observer.on_remark(remark)
    robot = faulty_robot(world, options)
    result = run_pipeline(restricted(robot or world), perception, request, observer)
    seconds = time.perf_counter() - begin - (observer.paused_seconds - paused)
    simulated = world.time - simulated_begin
    after = read_truth(world)
    objects = score_task(result.plan, result.objects, result.outcomes, before, after, _task_box(world, task))
    objects = [with_check(entry, result) for entry in objects]
    rows = score_reconstruction(result.objects, before, np.random.default_rng(options.seed))
    moves = unknown_moves(before, after)
    n_placed = sum(bool(entry.placed) for entry in objects)
    fault = None if robot is None else judge_fault(robot.as_dict(), objects, result, after.poses)
    complete = n_placed == len(objects) if fault is None else fault["complete"]
    report = Report(
        command=task,
        seed=options.seed,
        success=complete and not any(row["moved"] for row in moves),
        reason=summary_of(objects, result.failure, moves),
        timings={**result.timings, "total": seconds},
        objects=objects,
        metrics={
            "n_objects": len(objects),
            "n_perceived": len(result.objects),
            "n_placed": n_placed,
            "simulated_seconds": simulated,
            "cell_scale": world.config.scale,
            "reconstruction": rows,
            "unknown": moves,
            "obstacles": obstacle_rows(result.obstacles, result.frames),
        }
        | ({} if fault is None else {"fault": fault}),
        warnings=[
            *remarks,
            *(f"{item.name} is left out: {item.reason}" for item in result.rejected),
            *(obstacle_note(obstacle) for obstacle in result.obstacles),
        ],
        settings=settings_of(options),
    )
    return report, result


def request_of(world: World, task: Task, options: TaskOptions) -> TaskRequest:
    """Return the task in a cell, as the pipeline receives it; with ``--shapes oracle`` it has the true state.

    Args:
        world: The cell.
        task: "pack" or "sort".
        options: Options that choose the source of the object estimates.
    """
    box = planned_box(_task_box(world, task))
    reconstruction = reconstruction_of(options, partial(read_truth, world))
    scale = world.config.scale
    return TaskRequest(
        task, box, Line().scaled(scale), reconstruction,
        scan_views=options.scan_views, workspace=Workspace(scale), uncertainty=options.uncertainty == "on",
    )  # fmt: skip


def settings_of(options: TaskOptions) -> dict[str, Any]:
    """Return the options that determine an episode, by name."""
    names = {field.name for field in fields(TaskOptions)} - NOT_SETTINGS
    return {name: getattr(options, name) for name in sorted(names)}


def reconstruction_of(options: TaskOptions, read: Callable[[], Truth]) -> Reconstruction | None:
    """Return the source of object estimates for ``--shapes``; None for the learned shape prior.

    Ground truth is read for the oracle alone.
    """
    if options.shapes == "oracle":
        return lambda frames, detections: oracle_estimates(read())
    if options.shapes == "tsdf":
        return _tsdf
    return None


def with_check(entry: ObjectReport, result: TaskResult) -> ObjectReport:
    """Return the entry with the robot's own verification of the object among its details."""
    check = result.checks.get(entry.id)
    if check is None:
        return entry
    verification = {
        "seen": check.status,
        "seen_in_place": seen_in_place(check),
        "seen_shift": check.shift,
        "seen_tilt": check.tilt,
        "seen_inlier_share": check.inlier_share,
    }
    return replace(entry, details={**entry.details, **verification})


def seen_in_place(check: PoseCheck) -> bool:
    """Return whether the robot's verification found the object where it was to be."""
    return check.status == "seen" and check.tilt < MAX_TILT and check.shift < MAX_SHIFT


def summary_of(objects: Sequence[ObjectReport], failure: str, moves: Sequence[Mapping[str, Any]] = ()) -> str:
    """Return one line: the number of objects in place, and why the others are not.

    ``moves`` are the rows of ``unknown_moves``.
    """
    n_placed = sum(bool(entry.placed) for entry in objects)
    summary = f"{n_placed} of {len(objects)} objects in place"
    if moved := moved_things(moves):
        summary += f"; {moved}"
    if failure:
        return f"{summary}; {failure}"
    wrong = [f"{entry.category} {entry.id}: {entry.reason}" for entry in objects if not entry.placed]
    return f"{summary}; {'; '.join(wrong)}" if wrong else summary


def _task_box(world: World, task: Task) -> BoxConfig | None:
    """Return the box to pack into; None for sorting."""
    return world.config.box if task == "pack" else None


def planned_box(box: BoxConfig | None) -> Box | None:
    """The nominal dimensions of the box for the planner."""
    return box and Box(center=box.center, size=box.inner, floor=box.floor, wall=box.wall)


def _tsdf(frames: Sequence[RgbdFrame], detections: Detections) -> list[ObjectEstimate]:
    from perception.fusion.tsdf import reconstruct_tsdf

    return reconstruct_tsdf(frames, detections.per_frame, detections.plane)
