"""``pack --connect`` and ``sort --connect``: a task with a robot in another process, real or simulated.

There is no ground truth: an object counts as placed if the robot placed it and saw it in place afterwards.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields

from rich.markup import escape

from app.errors import UsageError
from app.options import CellOptions, CommonOptions, RunTaskOptions, Task
from app.runs.report import ObjectReport, Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from app.tables import object_table
from app.task.arm_cell import arm_cell, box_of
from app.task.cell import load_arm, parse_box
from app.task.episode import planned_box, seen_in_place
from app.task.overview import Overview, write_overview
from app.task.pipeline import run as run_pipeline
from app.task.run_observer import RunObserver, Stage
from app.task.run_writer import TITLES, plan_as_json
from app.task.task_types import TaskRequest, TaskResult
from manipulation.errors import ManipulationError
from manipulation.execution import TaskEvent
from manipulation.remote.calibration import read_hand_eye
from manipulation.remote.client import RemoteRobot
from manipulation.types import Line, TaskPlan
from manipulation.workspace import Workspace
from perception.io.detections import write_detections
from perception.io.object_map import write_object_map
from perception.io.scan_folder import write_scan
from perception.pipeline import Detections, load_perception
from perception.types import ObjectEstimate, RgbdFrame

_OF_THE_ROBOT = {"robot", "box"}  # options of the simulated cell that describe a real one as well


def run(options: RunTaskOptions, task: Task, screen: Screen) -> Report:
    """Connect to the robot, carry out the task, and store what the robot saw and did.

    Raises:
        UsageError: there is no such robot, or an option needs the simulated cell.
    """
    check_options(options)
    model = load_arm(options.robot)
    try:
        hand_eye = None if options.hand_eye is None else read_hand_eye(options.hand_eye)
        robot = RemoteRobot(model.description, options.connect, hand_eye)
    except ManipulationError as error:
        raise UsageError(str(error)) from None
    with robot:
        with screen.stage("Loading networks"):
            perception = load_perception(options.device)
        with RunFolder.create(options, task) as folder:
            screen.note(f"{task} with the robot at {options.connect}: {folder.path}")
            begin = time.perf_counter()
            request = request_of(options, task, arm_cell(options, model).scale)
            writer = StageWriter(options, task, folder, screen)
            result = run_pipeline(robot, perception, request, writer)
            report = report_of(options, task, result, time.perf_counter() - begin)
            folder.write_report(report)
            with screen.stage("Drawing the overview"):
                _write_overview(folder, report, result)
    screen.show(object_table(report))
    screen.show(escape(f"{report.reason}; details: {folder.path / 'report.json'}"))
    return report


def request_of(options: RunTaskOptions, task: Task, scale: float) -> TaskRequest:
    """Return the task in a cell of a scale relative to the standard one."""
    box = planned_box(box_of(options, parse_box(options.box), scale)) if task == "pack" else None
    line, workspace = Line().scaled(scale), Workspace(scale)
    return TaskRequest(
        task, box, line, scan_views=options.scan_views, workspace=workspace,
        uncertainty=options.uncertainty == "on",
    )  # fmt: skip


def check_options(options: RunTaskOptions) -> None:
    """Raise UsageError for options that need the simulated cell."""
    for field in fields(CellOptions):
        of_every_command = field.name in {f.name for f in fields(CommonOptions)} | _OF_THE_ROBOT
        default = None if field.default is MISSING else field.default
        if not of_every_command and getattr(options, field.name) != default:
            flag = field.name.replace("_", "-")
            raise UsageError(
                f"--{flag} describes the simulated cell: give it to nodeslam serve, not with --connect"
            )
    needs_cell = options.shapes != "nodeslam" or options.fault != "none" or options.log != "none"
    if needs_cell or options.view or options.video:
        raise UsageError(
            "--shapes, --fault, --view, --video and --log need the simulated cell: "
            "leave them out with --connect"
        )


def report_of(options: RunTaskOptions, task: Task, result: TaskResult, seconds: float) -> Report:
    """Return the report of a task, judged by the robot's own verification."""
    objects = [_object_report(estimate, result) for estimate in result.objects]
    n_placed = sum(bool(entry.placed) for entry in objects)
    reason = f"{n_placed} of {len(objects)} objects seen in place"
    wrong = [f"{entry.category} {entry.id}: {entry.reason}" for entry in objects if not entry.placed]
    return Report(
        command=task,
        seed=options.seed,
        success=bool(objects) and n_placed == len(objects) and not result.failure,
        reason="; ".join([reason, *([result.failure] if result.failure else wrong)]),
        timings={**result.timings, "total": seconds},
        objects=objects,
        metrics={"n_objects": len(objects), "n_perceived": len(objects), "n_placed": n_placed},
        warnings=[f"{item.name} is left out: {item.reason}" for item in result.rejected],
        settings={"connect": options.connect, "robot": options.robot, "box": options.box},
    )


def _object_report(estimate: ObjectEstimate, result: TaskResult) -> ObjectReport:
    outcome = next((outcome for outcome in result.outcomes if outcome.id == estimate.id), None)
    check = result.checks.get(estimate.id)
    left_out = "" if result.plan is None else result.plan.left_out.get(estimate.name, "")
    reason = outcome.reason if outcome is not None else left_out or "not attempted"
    placed = outcome is not None and outcome.placed and check is not None and seen_in_place(check)
    if outcome is not None and outcome.placed and not placed:
        reason = "not seen in place" if check is None else f"not seen in place ({check.status})"
    return ObjectReport(
        estimate.id,
        estimate.category,
        placed,
        None if check is None else check.shift,
        None if check is None else check.tilt,
        0 if outcome is None else outcome.attempts,
        "" if placed else reason,
    )


def _write_overview(folder: RunFolder, report: Report, result: TaskResult) -> None:
    placed = f"{report.metrics['n_placed']} of {len(report.objects)} objects in place"
    overview = Overview(
        title=f"{report.command.capitalize()}: {placed}",
        subtitle=report.reason[:150],
        before=result.frames[0].rgb if result.frames else None,
        after=result.final_frames[-1].rgb if result.final_frames else None,
        after_close=result.final_frames[0].rgb if result.final_frames else None,
        frames=result.frames,
        detections=result.detections,
        objects=result.objects,
        plan=result.plan,
        reports=report.objects,
    )
    write_overview(folder.path / "overview.png", overview)


class StageWriter(RunObserver):
    """Shows the progress of a task and stores the result of each stage."""

    def __init__(self, options: RunTaskOptions, task: Task, folder: RunFolder, screen: Screen) -> None:
        super().__init__()
        self._seed, self._task, self._folder, self._screen = options.seed, task, folder, screen

    @contextmanager
    def stage(self, name: Stage) -> Iterator[None]:
        reason = f"stopped while {TITLES[name].lower()}"
        self._folder.write_report(Report(self._task, self._seed, reason=reason, timings=self.timings))
        with self._screen.stage(TITLES[name]), super().stage(name):
            yield

    def on_progress(self, done: int, total: int, subject: str = "") -> None:
        self._screen.update(f"{done} of {total} {subject.replace('_', ' ')}")

    def on_frames(self, frames: Sequence[RgbdFrame]) -> None:
        write_scan(self._folder.scan, frames)

    def on_detections(self, detections: Detections) -> None:
        write_detections(self._folder.scan, detections.per_frame)

    def on_objects(self, objects: Sequence[ObjectEstimate]) -> None:
        for rejected in write_object_map(self._folder.path, objects):
            self.on_rejected(rejected)

    def on_plan(self, plan: TaskPlan) -> None:
        self._folder.write_json("plan.json", plan_as_json(plan))

    def on_event(self, event: TaskEvent) -> None:
        text = f"{event.phase} {event.name}".replace("_", " ")
        self._screen.update(f"{event.done} of {event.total}: {text}")
        if event.phase in ("retry", "failed", "deferred"):
            self._screen.note(f"{text}: {event.message}")
