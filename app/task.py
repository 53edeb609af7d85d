"""``nodeslam pack`` and ``nodeslam sort``: one episode in the simulated cell, stored, drawn and scored."""

from __future__ import annotations

from rich.markup import escape

from app.cell import build_world
from app.episode import run_episode
from app.options import PackOptions, RunTaskOptions, Task
from app.perceive import load_perception
from app.recording import CellRecorder
from app.report import Report
from app.run_folder import RunFolder
from app.screen import Screen
from app.storage import Storage
from app.tables import object_table


def run(options: RunTaskOptions, screen: Screen) -> Report:
    """One episode with everything stored: report, scan, object map, plan, replay, pictures."""
    task: Task = "pack" if isinstance(options, PackOptions) else "sort"
    folder = RunFolder.create(options, task)
    screen.note(f"{task}, seed {options.seed}: {folder.path}")
    with screen.stage("Building the cell"):
        world = build_world(options, task)
    with world:
        with screen.stage("Loading networks"):
            perception = load_perception(options.device)
        storage = Storage(options, task, folder, screen, world, CellRecorder(world))
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
