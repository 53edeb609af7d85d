"""``nodeslam pack`` and ``nodeslam sort``: one episode in the simulated cell, stored, drawn and scored."""

from __future__ import annotations

import contextlib

from app.options import RunTaskOptions
from app.runs.report import Report
from app.screen import Screen
from app.task.cell import build_world
from app.task.recording import CellRecorder
from app.task.run import run_in, task_of
from app.task.run_control import Gate
from perception.pipeline import load_perception


def run(options: RunTaskOptions, screen: Screen) -> Report:
    """One episode in a cell of its own; ``--view`` lets the browser watch."""
    with screen.stage("Building the cell"):
        world = build_world(options, task_of(options))
    with world, contextlib.ExitStack() as watching:
        recording, gate = CellRecorder(world), Gate()
        if options.view:
            from app.viewer.command import watch

            watching.enter_context(watch(options, recording.recorder, gate, screen))
        with screen.stage("Loading networks"):
            perception = load_perception(options.device)
        return run_in(world, options, perception, recording, screen, gate)
