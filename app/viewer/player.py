"""Lets show time pass: plays a story at a speed, follows one that still grows, jumps where it is told to.

Drawing happens in one thread of its own at a bounded rate; whoever records never waits for it.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable

from app.viewer.timeline import Story

_log = logging.getLogger(__name__)

RATE = 15.0  # [Hz] of drawing
# While a run computes in this process, drawing may use this share of what the run uses, and of wall time.
SHARE_OF_RUN, SHARE_OF_TIME = 0.06, 0.02
HEAD_START = 0.5  # [s] of processor time that drawing may use in advance
# After this time in [s] drawing hands the interpreter back to a run that waits for it.
HAND_OVER, USUAL_HAND_OVER = 5e-4, sys.getswitchinterval()
LAG = 1.0  # [s] behind the newest moment when following; further behind, time passes faster


class Player:
    """The clock of a viewer.

    Attributes:
        story: what is played.
        playing: whether time passes.
        live: whether the story still grows.
        yielding: whether a run computes in this process, which drawing must not slow down.
        following: whether it catches up with what is being recorded.
        speed: show seconds in a second.
        time: show time in [s].
    """

    def __init__(self, story: Story, draw: Callable[[], None], live: bool = False) -> None:
        self.story, self._draw = story, draw
        self.playing, self.live, self.following = True, live, live
        self.speed, self.time, self.yielding = 1.0, 0.0, False
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._problem = ""  # that was told last
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Stop drawing."""
        self._ended.set()
        self.give_way(False)
        if self._thread is not threading.current_thread() and self._thread.is_alive():
            self._thread.join(timeout=5)

    def give_way(self, yielding: bool) -> None:
        """Say whether a run computes in this process, whose threads take turns faster until it does not."""
        self.yielding = yielding
        sys.setswitchinterval(HAND_OVER if yielding else USUAL_HAND_OVER)

    def tell(self, story: Story, live: bool) -> None:
        """From now on another story, from its beginning."""
        with self._lock:
            self.story, self.time, self.playing = story, 0.0, True
            self.live = self.following = live

    def play(self) -> None:
        with self._lock:
            if self.time >= self.story.end and not self.following:
                self.time = 0.0
            self.playing = True

    def pause(self) -> None:
        with self._lock:
            self.playing = self.following = False

    def seek(self, show_time: float) -> None:
        """Go to a show time in [s] and, if the story still grows, no longer follow it."""
        with self._lock:
            self.time = min(max(show_time, 0.0), self.story.end)
            self.following = False

    def follow(self) -> None:
        """Catch up with what is being recorded."""
        with self._lock:
            self.playing = self.following = True

    def advance(self, seconds: float) -> None:
        """Let ``seconds`` of real time pass."""
        with self._lock:
            if not self.playing:
                return
            end = self.story.end
            speed = self.speed
            if self.following:  # faster the further behind, so that it is never far from now
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
            if self.yielding and not affordable(time.thread_time(), time.process_time(), now - begin):
                self._ended.wait(1 / RATE)
                continue
            try:
                self._draw()
            except Exception as error:  # a picture that fails must not end the view
                if repr(error) != self._problem:
                    _log.warning("the viewer could not draw", exc_info=True)
                self._problem = repr(error)
            self._ended.wait(max(1 / RATE - (time.perf_counter() - now), 0.5 / RATE))


def affordable(own: float, process: float, wall: float) -> bool:
    """Whether drawing has left the run enough of the processor.

    Args:
        own, process: processor time of drawing and of the whole process in [s].
        wall: since drawing began in [s].
    """
    return own < SHARE_OF_RUN * (process - own) + SHARE_OF_TIME * wall + HEAD_START
