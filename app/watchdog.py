"""Ends a stage that makes no progress, with its name.

On the main thread an alarm raises ``StalledError``, so that finished results are kept. Native code delays the
alarm: after a grace period a second thread ends the process, whose run folder the next run clears up as after
a kill.
"""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from types import FrameType
from typing import Any

from app.errors import StalledError

GRACE = 60.0  # [s] from the alarm to the end of the process
STALLED_EXIT_CODE = 1
_LONGEST_WAIT = 1.0  # [s] between checks of the time


class Watchdog:
    """Context of a stage; ``progress`` restarts its time. Other threads than the main one are not watched."""

    def __init__(self, title: str, limit: float, grace: float = GRACE) -> None:
        """Prepare a watchdog.

        Args:
            title: Name of the stage.
            limit: Time without progress after which it is ended [s]; 0 for none.
            grace: Time after which the process is ended if the stage does not react [s].
        """
        self._title, self._limit, self._grace = title, limit, grace
        self._active = False
        self._left = threading.Event()
        self._alarm_time = math.inf  # until then the stage is in time
        self._handler_before: Any = None

    def __enter__(self) -> Watchdog:
        if self._limit > 0 and threading.current_thread() is threading.main_thread():
            self._active = True
            threading.Thread(target=self._watch, name=f"watchdog of {self._title}", daemon=True).start()
            self._handler_before = signal.signal(signal.SIGALRM, self._raise)
            self.progress()
        return self

    def __exit__(self, *_: object) -> None:
        if self._active:
            self._active = False
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, self._handler_before)
            self._left.set()

    def progress(self) -> None:
        """Restart the time of the stage."""
        if self._active:
            self._alarm_time = time.monotonic() + self._limit
            signal.setitimer(signal.ITIMER_REAL, self._limit)

    @property
    def message(self) -> str:
        """What is reported of a stalled stage."""
        return (
            f"{self._title}: no progress for {self._limit:g} s: give it smaller input, or a larger "
            "--stage-limit"
        )

    def _raise(self, number: int, frame: FrameType | None) -> None:
        self._alarm_time = (
            math.inf
        )  # the stage reacts; `progress` starts the time of an evaluation's next job
        raise StalledError(self.message)

    def _watch(self) -> None:
        """End the process if the time of the stage passes without a reaction to the alarm."""
        while True:
            left = self._alarm_time + self._grace - time.monotonic()
            if self._left.wait(min(max(left, 0.01), _LONGEST_WAIT)):
                return
            if left <= 0:
                os.write(2, f"nodeslam: {self.message}\n".encode())
                os._exit(STALLED_EXIT_CODE)
