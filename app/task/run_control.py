"""Where a run waits while a person holds it. Simulated time stands still: what comes out is the same."""

from __future__ import annotations

import threading
import time


class Stopped(KeyboardInterrupt):
    """A person stopped the run; what was finished is kept."""


class Gate:
    """Open unless someone pauses, steps or stops the run; the run passes it at every moment that is recorded.

    Attributes:
        held: wall time in [s] that the run has waited in all.
    """

    def __init__(self) -> None:
        self.held = 0.0
        self._open = threading.Event()
        self._open.set()
        self._step = self._stop = False

    @property
    def paused(self) -> bool:
        return not self._open.is_set()

    def pause(self) -> None:
        self._open.clear()

    def resume(self) -> None:
        self._step = False
        self._open.set()

    def step(self) -> None:
        """Go on to the next mark: a stage or an action."""
        self._step = True
        self._open.set()

    def stop(self) -> None:
        self._stop = True
        self._open.set()

    def mark(self) -> None:
        """The run begins a stage or an action.

        Raises:
            Stopped: it shall not.
        """
        if self._step:
            self._step = False
            self._open.clear()
        self.passed()

    def passed(self) -> None:
        """The run comes by.

        Raises:
            Stopped: it shall end.
        """
        if not self._open.is_set():
            begin = time.perf_counter()
            self._open.wait()
            self.held += time.perf_counter() - begin
        if self._stop:
            raise Stopped
