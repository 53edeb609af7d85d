"""Durations of the stages of one frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Clock = Callable[[], float]


class StageTimer:
    """Sum of the durations of each stage, in seconds."""

    def __init__(self, clock: Clock = time.perf_counter) -> None:
        """Start with no stages; ``clock`` returns the time in seconds."""
        self._clock = clock
        self._seconds: dict[str, float] = {}

    @property
    def seconds(self) -> dict[str, float]:
        """Duration of each stage since the last reset."""
        return dict(self._seconds)

    def reset(self) -> None:
        """Forget all stages."""
        self._seconds = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the duration of a block to the stage's."""
        begin = self._clock()
        yield
        self._seconds[name] = self._seconds.get(name, 0.0) + self._clock() - begin
