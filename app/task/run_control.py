"""Pause, step and stop of a run. Simulated time stands still during a pause, so results do not change."""

from __future__ import annotations

import threading
import time


class RunStopped(KeyboardInterrupt):
    """A person stopped the run; finished results are kept."""


class RunControl:
    """Thread-safe pause, step and stop of a run.

    The run calls ``enter_step`` at the beginning of each stage and action, and ``wait_if_paused`` at each
    recorded sample. The other methods are for the user interface.

    Attributes:
        paused_seconds: Total wall time that the run has been paused, in seconds.
    """

    def __init__(self) -> None:
        self.paused_seconds = 0.0
        self._running = threading.Event()
        self._running.set()
        self._step = self._stop = False

    @property
    def paused(self) -> bool:
        return not self._running.is_set()

    def pause(self) -> None:
        self._running.clear()

    def resume(self) -> None:
        self._step = False
        self._running.set()

    def step(self) -> None:
        """Resume until the next stage or action begins."""
        self._step = True
        self._running.set()

    def stop(self) -> None:
        self._stop = True
        self._running.set()

    def enter_step(self) -> None:
        """Begin a stage or action; pause there after ``step``.

        Raises:
            RunStopped: The run has been stopped.
        """
        if self._step:
            self._step = False
            self._running.clear()
        self.wait_if_paused()

    def wait_if_paused(self) -> None:
        """Block while the run is paused.

        Raises:
            RunStopped: The run has been stopped.
        """
        if not self._running.is_set():
            begin = time.perf_counter()
            self._running.wait()
            self.paused_seconds += time.perf_counter() - begin
        if self._stop:
            raise RunStopped
