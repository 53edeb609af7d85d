"""A run that happens now: its buttons, and a session that starts runs from the browser.

The simulator lives in the main thread, where its graphics context was made; buttons leave messages there.
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Literal, get_args

import viser

from app.errors import AppError
from app.options import PackOptions, RunTaskOptions, SortOptions, Task, ViewOptions
from app.runs.report import Report
from app.screen import Screen
from app.task.cell import MAX_OBJECTS, build_world, parse_objects
from app.task.recording import CellRecorder
from app.task.run import run_and_store
from app.task.run_control import RunControl, RunStopped
from app.task.run_writer import RunSession
from app.viewer.panel import chosen
from app.viewer.viewer import Viewer
from perception.pipeline import Perception, load_perception
from sim_assets.cell.world import World

Command = Literal["new scene", "run", "end"]
MAX_SEED = 2**31 - 1


class RunButtons:
    """Pause, Step and Stop of a run."""

    def __init__(self, gui: viser.GuiApi, control: Callable[[], RunControl]) -> None:
        self._control = control
        self._pause = gui.add_button("Pause the robot", icon=viser.Icon.HAND_STOP)
        self._step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT, hint="On to the next action")
        self._stop = gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP, color="red")

        @self._pause.on_click
        def _(_: viser.GuiEvent) -> None:
            control().resume() if control().paused else control().pause()
            self.show(running=True)

        @self._step.on_click
        def _(_: viser.GuiEvent) -> None:
            control().step()

        @self._stop.on_click
        def _(_: viser.GuiEvent) -> None:
            control().stop()

    def show(self, running: bool) -> None:
        """Let the buttons say what they do."""
        for button in (self._pause, self._step, self._stop):
            button.disabled = not running
        self._pause.label = "Let the robot go on" if running and self._control().paused else "Pause the robot"


class Session:
    """Scenes and runs, one after another, as the browser asks for them."""

    def __init__(self, options: ViewOptions, viewer: Viewer, screen: Screen) -> None:
        self._options, self._viewer, self._screen = options, viewer, screen
        self._commands: queue.Queue[Command] = queue.Queue()
        self._control = RunControl()
        self._perception: Perception | None = None
        self._world: World | None = None
        self._shown: RunTaskOptions | None = None  # what the scene was made from
        self._fresh = False  # nothing has moved in it yet
        gui = viewer.server.gui
        with gui.add_folder("Robot", order=1):
            self._task = gui.add_dropdown("Task", get_args(Task), initial_value=options.task)
            self._count = gui.add_slider("Objects", 1, 10, 1, self._initial_count(options))
            self._seed = gui.add_number("Seed", options.seed, min=0, max=MAX_SEED, step=1)
            self._new = gui.add_button("New scene", icon=viser.Icon.REFRESH)
            self._run = gui.add_button("Run", icon=viser.Icon.ROBOT, color="green")
            self._buttons = RunButtons(gui, lambda: self._control)
        self._new.on_click(lambda _: self._commands.put("new scene"))
        self._run.on_click(lambda _: self._commands.put("run"))

    def end(self) -> None:
        """Let ``serve`` return when what is under way is done; from any thread."""
        self._commands.put("end")

    def serve(self) -> None:
        """Do what the buttons ask for until interrupted, or until the end is asked for."""
        try:
            self._new_scene(self._options.seed)
            while True:
                self._allow(True)
                command = self._commands.get()
                while command != "end" and not self._commands.empty():  # clicks while the last one was done
                    command = self._commands.get()
                if command == "end":
                    break
                self._allow(False)
                self._do(command)
        finally:
            if self._world is not None:
                self._world.close()

    def _do(self, command: Command) -> None:
        try:
            seed = min(max(int(self._seed.value), 0), MAX_SEED)
            if command == "new scene":
                self._new_scene(seed + 1 if self._shown and self._shown.seed == seed else seed)
            else:
                self._run_here(seed)
        except (AppError, ValueError, RuntimeError) as error:  # no scene, no plan: the next one may do better
            self._viewer.title("That did not work", str(error))
            self._screen.note(str(error))

    def _new_scene(self, seed: int) -> None:
        self._viewer.title("A new scene ...", f"seed {seed}")
        options = self._chosen(seed)
        if self._world is not None:
            self._world.close()
        self._world, self._shown, self._fresh = None, None, False
        self._world = build_world(options, self._task_chosen)
        self._shown, self._fresh = options, True
        self._recording = CellRecorder(self._world)
        self._seed.value = seed
        self._viewer.show(self._recording.recorder, live=True)
        self._viewer.title(f"{self._task_chosen.capitalize()}, seed {seed}", "ready: press Run")

    def _run_here(self, seed: int) -> None:
        if not self._fresh or self._shown != self._chosen(seed):
            self._new_scene(seed)
        assert self._world is not None and self._shown is not None
        self._control, self._fresh = RunControl(), False
        self._buttons.show(running=True)
        self._viewer.player.give_way(True)
        title = f"{self._task_chosen.capitalize()}, seed {seed}"
        self._viewer.title(title, "the robot is at work")
        try:
            if self._perception is None:
                self._perception = load_perception(self._options.device)
            session = RunSession(self._world, self._recording, self._control, self._screen)
            report = run_and_store(self._shown, self._perception, session)
            show_result(self._viewer, report)
        except RunStopped:
            self._viewer.title(title, "stopped; what was finished is kept")
        finally:
            self._viewer.player.give_way(False)
            self._buttons.show(running=False)

    def _allow(self, free: bool) -> None:
        self._new.disabled = self._run.disabled = not free
        if free:
            self._buttons.show(running=False)

    @property
    def _task_chosen(self) -> Task:
        return chosen(self._task, get_args(Task))

    def _chosen(self, seed: int) -> RunTaskOptions:
        """The options of a run, as the controls stand."""
        kind = PackOptions if self._task_chosen == "pack" else SortOptions
        names = {field.name for field in fields(kind)} & {field.name for field in fields(self._options)}
        options = kind(**{name: getattr(self._options, name) for name in names})
        count = min(max(int(self._count.value), 1), 10)
        objects = options.objects if count == self._initial_count(self._options) else str(count)
        return replace(options, seed=seed, objects=objects)

    @staticmethod
    def _initial_count(options: ViewOptions) -> int:
        import numpy as np

        return min(len(parse_objects(options.objects, np.random.default_rng(0))), MAX_OBJECTS, 10)


def show_result(viewer: Viewer, report: Report) -> None:
    """Say how it went."""
    written = report.as_json()
    viewer.title(f"{report.command.capitalize()}, seed {report.seed}", report.reason, written["objects"])
