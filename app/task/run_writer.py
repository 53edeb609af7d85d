"""Stores a run while it happens: the result of each stage is on disk as soon as the stage is finished."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from app.options import RunTaskOptions, Task
from app.runs.report import Report, moved_things
from app.runs.rerun_log import write_rerun
from app.runs.run_folder import RunFolder
from app.screen import Screen
from app.task.obstacles import picture_name, portrait_of
from app.task.overview import Overview, write_overview
from app.task.recording import RATE, CellRecorder
from app.task.run_control import RunControl
from app.task.run_observer import RunObserver, Stage
from app.task.task_types import TaskResult
from app.task.video import RunVideo
from manipulation.execution import TaskEvent
from manipulation.types import TaskPlan
from perception.inference.optimisation import FitStep
from perception.io.detections import write_detections
from perception.io.files import write_atomically
from perception.io.images import png_bytes
from perception.io.object_map import write_object_map
from perception.io.scan_folder import write_scan
from perception.obstacles.obstacle import PerceivedObstacle
from perception.pipeline import Detections
from perception.types import Category, ObjectEstimate, RgbdFrame
from sim_assets.cell.world import World

TITLES: dict[Stage, str] = {
    "scan": "Scanning the table",
    "detect": "Detecting objects",
    "reconstruct": "Reconstructing whole shapes",
    "plan": "Planning",
    "execute": "Moving objects",
    "verify": "Verifying the result",
}
CLOSE_CAMERA: dict[Task, str] = {"pack": "box", "sort": "line"}


@dataclass(frozen=True)
class RunSession:
    """A cell with everything attached to it for the duration of a run.

    Attributes:
        world: Simulated cell.
        recording: Recorder of the cell for viewers.
        control: Pause, step and stop.
        screen: Terminal output.
    """

    world: World
    recording: CellRecorder
    control: RunControl
    screen: Screen


class RunWriter(RunObserver):
    """Observes a run: shows its progress, writes its folder, records replay and video."""

    def __init__(self, options: RunTaskOptions, task: Task, folder: RunFolder, session: RunSession) -> None:
        super().__init__()
        self._options, self._folder = options, folder
        self._task: Task = task
        self._screen, self._world = session.screen, session.world
        self._recording, self._control = session.recording, session.control
        self._begin = time.perf_counter()
        self._recording.recorder.write_meshes(folder.path)
        self._before = self._world.overview_image()
        self._frames: Sequence[RgbdFrame] = ()
        self._video: RunVideo | None = None
        if options.video:
            self._video = RunVideo(folder.path / "video.mp4", task.capitalize(), self._world)
        self._world.observe(self._sample, RATE)

    @property
    def paused_seconds(self) -> float:
        return self._control.paused_seconds

    @contextmanager
    def stage(self, name: Stage) -> Iterator[None]:
        self._write_progress(f"stopped while {TITLES[name].lower()}")
        self._recording.begin_stage(name)
        self._control.enter_step()
        if self._video is not None:
            self._video.begin_stage(name)
        before = self.timings.get(name, 0.0)  # of the rounds before
        with self._screen.stage(TITLES[name]), super().stage(name):
            yield
        self._recording.end_stage(name, self.timings[name] - before)

    def on_remark(self, text: str) -> None:
        self._screen.note(text)

    def on_progress(self, done: int, total: int, subject: str = "") -> None:
        self._screen.update(f"{done} of {total} {subject.replace('_', ' ')}")

    def on_image(self, frame: RgbdFrame) -> None:
        self._recording.on_image(frame)
        if self._video is not None:
            self._video.on_image(frame)
        self._control.wait_if_paused()

    def on_frames(self, frames: Sequence[RgbdFrame]) -> None:
        if self._video is not None:
            self._video.on_frames(frames)
        self._frames = frames
        write_scan(self._folder.scan, frames)

    def on_detections(self, detections: Detections) -> None:
        self._recording.on_detections(detections)
        if self._video is not None:
            self._video.on_detections(detections)
        write_detections(self._folder.scan, detections.per_frame)

    def on_fit_step(self, object_id: int, category: Category, step: FitStep) -> None:
        self._recording.on_fit_step(object_id, category, step)
        self._control.wait_if_paused()

    def on_objects(self, objects: Sequence[ObjectEstimate]) -> None:
        self._recording.on_objects(objects)
        if self._video is not None:
            self._video.on_objects(objects)
        for rejected in write_object_map(self._folder.path, objects):
            self.on_rejected(rejected)

    def on_obstacles(self, obstacles: Sequence[PerceivedObstacle]) -> None:
        self._recording.on_obstacles(obstacles)
        for obstacle in obstacles:
            portrait = portrait_of(obstacle, self._frames)
            if portrait is not None:
                picture = png_bytes(portrait.picture(self._frames))
                write_atomically(self._folder.path / picture_name(obstacle), picture)

    def on_plan(self, plan: TaskPlan) -> None:
        self._recording.on_plan(plan)
        if self._video is not None:
            self._video.on_plan(plan)
        self._folder.write_json("plan.json", plan_as_json(plan))

    def on_event(self, event: TaskEvent) -> None:
        text = f"{event.phase} {event.name}".replace("_", " ")
        self._recording.on_event(event)
        self._control.enter_step()
        self._screen.update(f"{event.done} of {event.total}: {text}")
        if event.phase in ("retry", "failed", "deferred"):
            self._screen.note(f"{text}: {event.message}")
        if self._video is not None:
            self._video.on_event(event)

    def close(self) -> None:
        """Finish replay and video, also after an interruption."""
        self._world.observe(None)
        self._recording.recorder.write(self._folder.path)
        if self._options.log == "rerun":
            write_rerun(self._recording.recorder, self._folder.path)
        if self._video is not None:
            self._video.close()

    def write_overview(self, report: Report, result: TaskResult) -> None:
        """Write ``overview.png``."""
        overview = Overview(
            title=f"{self._task.capitalize()}: {report.metrics['n_placed']} of {len(report.objects)} "
            "objects in place",
            subtitle=subtitle_of(report),
            before=self._before,
            after=self._world.overview_image(),
            after_close=self._world.overview_image(camera=CLOSE_CAMERA[self._task]),
            frames=result.frames,
            detections=result.detections,
            objects=result.objects,
            plan=result.plan,
            obstacles=result.obstacles,
            reports=report.objects,
        )
        write_overview(self._folder.path / "overview.png", overview)

    def _write_progress(self, reason: str) -> None:
        timings = self.timings | {"total": time.perf_counter() - self._begin}
        self._folder.write_report(Report(self._task, self._options.seed, reason=reason, timings=timings))

    def _sample(self, world: World) -> None:
        self._recording.sample()
        self._control.wait_if_paused()
        if self._video is not None:
            self._video.sample()


def subtitle_of(report: Report) -> str:
    """Return verdict, moved things of no class, seed, and the wall and simulated time of the episode."""
    verdict = "done" if report.success else "not done"
    moved = moved_things(report.metrics.get("unknown", ()))
    verdict = ", ".join(filter(None, (verdict, moved)))
    wall, simulated = report.timings["total"], report.metrics["simulated_seconds"]
    return f"{verdict} · seed {report.seed} · {wall:.0f} s wall, {simulated:.0f} s robot time"


def plan_as_json(plan: TaskPlan) -> dict[str, Any]:
    """Return the content of ``plan.json``: placements in order of execution, in metres and radians."""
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
