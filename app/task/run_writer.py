"""Stores a run while it happens: each stage's result is on disk as soon as the stage is done."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from app.options import RunTaskOptions, Task
from app.runs.report import Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from app.task.overview import Pictures, write_overview
from app.task.pipeline import Outcome, Watcher
from app.task.recording import RATE, CellRecorder
from app.task.run_control import Gate
from app.task.video import Film
from manipulation.execution import TaskEvent
from manipulation.types import TaskPlan
from perception.inference.fit import FitStep
from perception.io.object_map import write_object_map
from perception.io.scan_folder import write_detections, write_scan
from perception.types import Category, RgbdFrame
from sim_assets.cell.world import World

TITLES = {
    "scan": "Looking at the table",
    "detect": "Finding objects",
    "reconstruct": "Reconstructing whole shapes",
    "plan": "Planning",
    "execute": "Moving objects",
    "verify": "Looking again",
}
CLOSE_CAMERA: dict[str, str] = {"pack": "box", "sort": "line"}


class Storage(Watcher):
    """Watches a run: shows its progress, writes its folder, records replay and video."""

    def __init__(
        self,
        options: RunTaskOptions,
        task: Task,
        folder: RunFolder,
        screen: Screen,
        world: World,
        recording: CellRecorder,
        gate: Gate,
    ) -> None:
        super().__init__()
        self._options, self._task = options, task
        self._folder, self._screen, self._world = folder, screen, world
        self._begin = time.perf_counter()
        self._recording, self._gate = recording, gate
        recording.recorder.write_meshes(folder.path)
        self._before = world.overview_image()
        self._film = Film(folder.path / "video.mp4", task.capitalize(), world) if options.video else None
        world.observe(self._sample, RATE)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self._write_progress(f"stopped while {TITLES[name].lower()}")
        self._recording.begin(name)
        self._gate.mark()
        held = self._gate.held
        if self._film is not None:
            self._film.begin(name)
        with self._screen.stage(TITLES[name]), super().stage(name):
            yield
        self.timings[name] -= self._gate.held - held
        self._recording.done(name, self.timings[name])

    def progress(self, done: int, total: int, what: str = "") -> None:
        self._screen.update(f"{done} of {total} {what.replace('_', ' ')}")

    def event(self, event: TaskEvent) -> None:
        text = f"{event.phase} {event.name}".replace("_", " ")
        self._recording.event(event)
        self._gate.mark()
        self._screen.update(f"{event.done} of {event.total}: {text}")
        if event.phase in ("retry", "failed", "deferred"):
            self._screen.note(f"{text}: {event.message}")
        if self._film is not None:
            self._film.event(event)

    def looked(self, frame: RgbdFrame) -> None:
        self._recording.looked(frame)
        if self._film is not None:
            self._film.looked(frame)
        self._gate.passed()

    def fit_step(self, object_id: int, category: Category, step: FitStep) -> None:
        self._recording.fit_step(object_id, category, step)
        self._gate.passed()

    def made(self, name: str, value: Any) -> None:
        """Write what a stage made; the folder stays readable at any moment."""
        self._recording.made(name, value)
        if self._film is not None:
            self._film.made(name, value)
        if name == "frames":
            write_scan(self._folder.scan, value)
        elif name == "detections":
            write_detections(self._folder.scan, value.per_frame)
        elif name == "objects":
            write_object_map(self._folder.path, value)
        elif name == "plan":
            self._folder.write_json("plan.json", plan_as_json(value))

    def close(self) -> None:
        """Finish replay and video, also after an interruption."""
        self._world.observe(None)
        self._recording.recorder.write(self._folder.path)
        if self._film is not None:
            self._film.close()

    def draw(self, report: Report, outcome: Outcome) -> None:
        """Compose ``overview.png``."""
        done = "done" if report.success else "not done"
        counts = f"{report.metrics['n_placed']} of {len(report.objects)} objects in place"
        times = (
            f"{report.timings['total']:.0f} s wall, {report.metrics['simulated_seconds']:.0f} s robot time"
        )
        pictures = Pictures(
            title=f"{self._task.capitalize()}: {counts}",
            subtitle=f"{done} · seed {report.seed} · {times}",
            before=self._before,
            after=self._world.overview_image(),
            after_close=self._world.overview_image(camera=CLOSE_CAMERA[self._task]),
            frames=outcome.frames,
            detections=outcome.detections,
            objects=outcome.objects,
            plan=outcome.plan,
            reports=report.objects,
        )
        write_overview(self._folder.path / "overview.png", pictures)

    def _write_progress(self, reason: str) -> None:
        timings = self.timings | {"total": time.perf_counter() - self._begin}
        self._folder.write_report(Report(self._task, self._options.seed, reason=reason, timings=timings))

    def _sample(self, world: World) -> None:
        self._recording.sample()
        self._gate.passed()
        if self._film is not None:
            self._film.sample()


def plan_as_json(plan: TaskPlan) -> dict[str, Any]:
    """``plan.json``: placements in the order of execution, in metres and radians."""
    return {
        "task": plan.task,
        "placements": [
            {
                "name": placement.name,
                "from": plan.objects[placement.name].T_world_stand[:3, 3].tolist(),
                "position": [float(x) for x in placement.position],
                "yaws": [float(yaw) for yaw in placement.yaws],
                "stack": list(placement.stack),
            }
            for placement in plan.placements
        ],
        "left_out": dict(plan.left_out),
    }
