"""Joint optimisation beside tracking, in a thread; most of its time is spent without the GIL.

The result of a keyframe's window is applied a fixed number of frames later, not when it happens to be ready,
so that a run does not depend on the machine's speed.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

from perception.threads import single_threaded

Result = TypeVar("Result")


class DelayedJob(Generic[Result]):
    """At most one job, whose result is due at a frame.

    Attributes:
        due: Number of the frame at which the result is taken; None without a job.
    """

    def __init__(self, concurrent: bool = True) -> None:
        """Create the thread; without ``concurrent``, jobs run at once in the caller's."""
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="joint") if concurrent else None
        self._future: Future[Result] | None = None
        self.due: int | None = None

    def start(self, job: Callable[[], Result], due: int) -> None:
        """Start a job; the one before must have been taken."""
        assert self._future is None
        self.due = due
        if self._pool is not None:
            self._future = self._pool.submit(_on_one_thread, job)
            return
        self._future = Future()
        self._future.set_result(job())

    def take(self) -> Result:
        """Wait for the job and return its result; raises what the job raised."""
        assert self._future is not None
        future, self._future, self.due = self._future, None, None
        return future.result()


def _on_one_thread(job: Callable[[], Result]) -> Result:
    with single_threaded():
        return job()
