"""Live runs: the buttons of a run, and a session that starts runs from the browser.

The simulator runs in the main thread, which owns its graphics context; buttons send it commands by a queue.
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Literal, get_args

import numpy as np
import viser

from app.errors import AppError
from app.memory import release_freed_memory
from app.options import PackOptions, RunTaskOptions, SortOptions, Task, ViewOptions
from app.runs.report import Report
from app.screen import Screen
from app.task.cell import MAX_OBJECTS, build_world, parse_objects
from app.task.recording import CellRecorder
from app.task.run import run_and_store
from app.task.run_control import RunControl, RunStopped
from app.task.run_writer import RunSession
from app.viewer.panel import selected
from app.viewer.snapshot import ObjectOutcome
from app.viewer.viewer import Viewer
from perception.pipeline import Perception, load_perception
from sim_assets.cell.world import World

Command = Literal["new scene", "run", "end"]
PAUSE, RESUME = "Pause", "Resume"
MAX_SEED = 2**31 - 1
MAX_COUNT = min(MAX_OBJECTS, 10)  # of the slider


class RunButtons:
    """Buttons to pause, step and stop a run.

    Args:
        gui: Panel to which the buttons are added.
        control: Returns the control of the current run.
    """

    def __init__(self, gui: viser.GuiApi, control: Callable[[], RunControl]) -> None:
        self._control = control
        self._pause = gui.add_button(f"{PAUSE} robot", icon=viser.Icon.HAND_STOP)
        self._step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT, hint="Run to the next action")
        self._stop = gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP, color="red")

        @self._pause.on_click
        def _(_: viser.GuiEvent) -> None:
            control().resume() if control().paused else control().pause()
            self.update(running=True)

        @self._step.on_click
        def _(_: viser.GuiEvent) -> None:
            control().step()

        @self._stop.on_click
        def _(_: viser.GuiEvent) -> None:
            control().stop()

    def update(self, running: bool) -> None:
        """Enable the buttons during a run, and label the first one with its action."""
        for button in (self._pause, self._step, self._stop):
            button.disabled = not running
        self._pause.label = f"{RESUME if running and self._control().paused else PAUSE} robot"


class LiveSession:
    """Builds scenes and runs tasks at the request of the browser, one at a time."""

    def __init__(self, options: ViewOptions, viewer: Viewer, screen: Screen) -> None:
        self._options, self._viewer, self._screen = options, viewer, screen
        self._commands: queue.Queue[Command] = queue.Queue()
        self._control = RunControl()
        self._perception: Perception | None = None
        self._world: World | None = None
        self._scene: RunTaskOptions | None = None  # options of the current scene
        self._unused = False  # whether no run has changed the scene
        gui = viewer.server.gui
        with gui.add_folder("Robot", order=1):
            self._task = gui.add_dropdown("Task", get_args(Task), initial_value=options.task)
            self._count = gui.add_slider("Objects", 1, MAX_COUNT, 1, _initial_count(options))
            self._seed = gui.add_number("Seed", options.seed, min=0, max=MAX_SEED, step=1)
            self._new = gui.add_button("New scene", icon=viser.Icon.REFRESH)
            self._run = gui.add_button("Run", icon=viser.Icon.ROBOT, color="green")
            self._buttons = RunButtons(gui, lambda: self._control)
        self._new.on_click(lambda _: self._commands.put("new scene"))
        self._run.on_click(lambda _: self._commands.put("run"))

    def end(self) -> None:
        """Let ``serve`` return after the current command; may be called from any thread."""
        self._commands.put("end")

    def serve(self) -> None:
        """Execute commands until ``end`` is called."""
        try:
            self._build_scene(self._options.seed)
            while True:
                self._set_idle(True)
                command = self._commands.get()
                while command != "end" and not self._commands.empty():  # clicks during the last command
                    command = self._commands.get()
                if command == "end":
                    break
                self._set_idle(False)
                self._execute(command)
        finally:
            if self._world is not None:
                self._world.close()

    def _execute(self, command: Command) -> None:
        try:
            seed = min(max(int(self._seed.value), 0), MAX_SEED)
            if command == "new scene":
                unchanged = self._scene is not None and self._scene.seed == seed
                self._build_scene(seed + 1 if unchanged else seed)
            else:
                self._run_task(seed)
        except (AppError, ValueError, RuntimeError) as error:  # another scene may succeed
            self._viewer.set_title("Failed", str(error))
            self._screen.note(str(error))

    def _build_scene(self, seed: int) -> None:
        self._viewer.set_title("Building the scene ...", f"seed {seed}")
        options = self._selected_options(seed)
        if self._world is not None:
            self._world.close()
        self._world, self._scene, self._unused = None, None, False
        release_freed_memory()
        self._world = build_world(options, self._selected_task)
        self._scene, self._unused = options, True
        self._recording = CellRecorder(self._world)
        self._seed.value = seed
        self._viewer.show(self._recording.recorder, live=True)
        self._viewer.set_title(self._title(seed), "ready: press Run")

    def _run_task(self, seed: int) -> None:
        if not self._unused or self._scene != self._selected_options(seed):
            self._build_scene(seed)
        assert self._world is not None and self._scene is not None
        self._control, self._unused = RunControl(), False
        self._buttons.update(running=True)
        self._viewer.player.set_yielding(True)
        self._viewer.set_title(self._title(seed), "running")
        try:
            if self._perception is None:
                self._perception = load_perception(self._options.device)
            session = RunSession(self._world, self._recording, self._control, self._screen)
            report = run_and_store(self._scene, self._perception, session)
            self._viewer.set_title(self._title(seed), report.reason, outcomes(report))
        except RunStopped:
            self._viewer.set_title(self._title(seed), "stopped; finished results are kept")
        finally:
            self._viewer.player.set_yielding(False)
            self._buttons.update(running=False)

    def _set_idle(self, idle: bool) -> None:
        self._new.disabled = self._run.disabled = not idle
        if idle:
            self._buttons.update(running=False)

    def _title(self, seed: int) -> str:
        return f"{self._selected_task.capitalize()}, seed {seed}"

    @property
    def _selected_task(self) -> Task:
        return selected(self._task, get_args(Task))

    def _selected_options(self, seed: int) -> RunTaskOptions:
        """Return the options of a run that the controls select."""
        kind = PackOptions if self._selected_task == "pack" else SortOptions
        names = {field.name for field in fields(kind)} & {field.name for field in fields(self._options)}
        options = kind(**{name: getattr(self._options, name) for name in names})
        count = min(max(int(self._count.value), 1), MAX_COUNT)
        objects = options.objects if count == _initial_count(self._options) else str(count)
        return replace(options, seed=seed, objects=objects)


def outcomes(report: Report) -> dict[int, ObjectOutcome]:
    """Return the outcomes of the objects of a report by id."""
    return {entry.id: ObjectOutcome(bool(entry.placed), entry.error_position) for entry in report.objects}


def _initial_count(options: ViewOptions) -> int:
    return min(len(parse_objects(options.objects, np.random.default_rng(0))), MAX_COUNT)
