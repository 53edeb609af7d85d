"""One episode in a cell that is there already, with all that is kept of it."""

from __future__ import annotations

from rich.markup import escape

from app.options import PackOptions, RunTaskOptions, Task
from app.runs.report import Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from app.tables import object_table
from app.task.episode import run_episode
from app.task.recording import CellRecorder
from app.task.run_control import Gate
from app.task.run_writer import Storage
from perception.pipeline import Perception
from sim_assets.cell.world import World


def run_in(
    world: World,
    options: RunTaskOptions,
    perception: Perception,
    recording: CellRecorder,
    screen: Screen,
    gate: Gate,
) -> Report:
    """One episode with everything stored: report, scan, object map, plan, replay, pictures.

    Raises:
        Stopped: the gate was told so; what was finished is kept.
    """
    task = task_of(options)
    folder = RunFolder.create(options, task)
    screen.note(f"{task}, seed {options.seed}: {folder.path}")
    storage = Storage(options, task, folder, screen, world, recording, gate)
    try:
        report, outcome = run_episode(world, options, task, perception, storage)
    finally:
        storage.close()
    folder.write_report(report)
    with screen.stage("Drawing the overview"):
        storage.draw(report, outcome)
    screen.show(object_table(report))
    screen.show(escape(f"{folder.path / 'overview.png'} shows what happened; report.json tells it."))
    return report


def task_of(options: RunTaskOptions) -> Task:
    """Which task the options are for."""
    return "pack" if isinstance(options, PackOptions) else "sort"
