"""Playback of a timeline: speed, seeking, and following a recording that still grows.

Drawing happens in a thread of its own at a bounded rate; the recording never waits for it.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable

from app.viewer.timeline import Timeline

logger = logging.getLogger(__name__)

RATE = 15.0  # [Hz] of drawing
# While a run computes in this process, drawing may use these shares of the run's CPU time and of wall time.
SHARE_OF_RUN, SHARE_OF_WALL = 0.06, 0.02
CPU_CREDIT = 0.5  # [s] of CPU time that drawing may use in advance
# Thread switch interval [s] while a run computes: short, so that drawing yields quickly to the run.
YIELDING_SWITCH_INTERVAL, DEFAULT_SWITCH_INTERVAL = 5e-4, sys.getswitchinterval()
LAG = 1.0  # [s] time constant with which playback catches up while following


class Player:
    """Playback clock of a viewer.

    Attributes:
        timeline: The timeline that is played.
        playing: Whether time advances.
        live: Whether the recording may still grow.
        following: Whether playback keeps up with the end of a growing recording.
        yielding: Whether a run computes in this process, whose speed drawing must not reduce.
        speed: Show time per real time.
        time: Current show time in seconds.
    """

    def __init__(self, timeline: Timeline, draw: Callable[[], None], live: bool = False) -> None:
        self.timeline, self._draw = timeline, draw
        self.playing, self.live, self.following = True, live, live
        self.speed, self.time, self.yielding = 1.0, 0.0, False
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._reported = ""  # the error that was logged last
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)

    def start(self) -> None:
        """Start drawing."""
        self._thread.start()

    def close(self) -> None:
        """Stop drawing."""
        self._ended.set()
        self.set_yielding(False)
        if self._thread is not threading.current_thread() and self._thread.is_alive():
            self._thread.join(timeout=5)

    def set_yielding(self, yielding: bool) -> None:
        """Begin or end the time in which drawing yields to a run in this process."""
        self.yielding = yielding
        sys.setswitchinterval(YIELDING_SWITCH_INTERVAL if yielding else DEFAULT_SWITCH_INTERVAL)

    def load(self, timeline: Timeline, live: bool) -> None:
        """Play another timeline from its beginning."""
        with self._lock:
            self.timeline, self.time, self.playing = timeline, 0.0, True
            self.live = self.following = live

    def play(self) -> None:
        """Let time advance; from the beginning if it is at the end."""
        with self._lock:
            if self.time >= self.timeline.end and not self.following:
                self.time = 0.0
            self.playing = True

    def pause(self) -> None:
        with self._lock:
            self.playing = self.following = False

    def seek(self, show_time: float) -> None:
        """Go to a show time in seconds, limited to the timeline, and stop following."""
        with self._lock:
            self.time = min(max(show_time, 0.0), self.timeline.end)
            self.following = False

    def follow(self) -> None:
        """Catch up with the end of a growing recording and keep up with it."""
        with self._lock:
            self.playing = self.following = True

    def advance(self, seconds: float) -> None:
        """Advance by a real time in seconds."""
        with self._lock:
            if not self.playing:
                return
            end = self.timeline.end
            speed = self.speed
            if self.following:  # the faster, the further behind
                speed = max(speed, (end - self.time) / LAG)
            self.time = min(self.time + speed * seconds, end)
            if self.time >= end and not self.following:
                self.playing = False

    def _run(self) -> None:
        begin = last = time.perf_counter()
        while not self._ended.is_set():
            now = time.perf_counter()
            self.advance(now - last)
            last = now
            if self.yielding and not within_cpu_budget(time.thread_time(), time.process_time(), now - begin):
                self._ended.wait(1 / RATE)
                continue
            try:
                self._draw()
            except Exception as error:  # an error in one image must not end the viewer
                if repr(error) != self._reported:
                    logger.warning("the viewer could not draw", exc_info=True)
                self._reported = repr(error)
            self._ended.wait(max(1 / RATE - (time.perf_counter() - now), 0.5 / RATE))


def within_cpu_budget(drawing: float, process: float, wall: float) -> bool:
    """Return whether drawing has used less than its share of CPU time.

    Args:
        drawing, process: CPU time of the drawing thread and of the whole process in seconds.
        wall: Wall time since drawing began in seconds.
    """
    return drawing < SHARE_OF_RUN * (process - drawing) + SHARE_OF_WALL * wall + CPU_CREDIT
