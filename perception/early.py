"""Reconstruction of the first images of a scan while the robot takes the others::

    with EarlyReconstruction(reconstruct, after=3) as early:
        for frame in scan:
            early.add(frame)
        starts = early.estimates()

The estimates are ready before the scan has ended, as a robot moves for seconds between two images; they are
the starting points of the fits to all images (``reconstruct_objects``). Which images are used is a number,
not a matter of time: the same images give the same estimates on any machine.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from perception.errors import PerceptionError
from perception.threads import single_threaded
from perception.types import ObjectEstimate, RgbdFrame

logger = logging.getLogger(__name__)

Reconstruct = Callable[[Sequence[RgbdFrame]], Sequence[ObjectEstimate]]


class EarlyReconstruction:
    """Reconstructs the objects of the first images in a thread of its own.

    While it is open, numerical libraries run on one thread each: their results depend on that number.

    Args:
        reconstruct: Returns the objects that images show.
        after: Number of images that are used; 0 for no early reconstruction.
    """

    def __init__(self, reconstruct: Reconstruct, after: int) -> None:
        self._reconstruct, self._after = reconstruct, after
        self._frames: list[RgbdFrame] = []
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="early")
        self._job: Future[Sequence[ObjectEstimate]] | None = None
        self._threads = single_threaded()

    def __enter__(self) -> EarlyReconstruction:
        self._threads.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(cancel_futures=True)
        self._threads.__exit__(kind, error, trace)

    def add(self, frame: RgbdFrame) -> None:
        """Receive an image; the last one that is used starts the reconstruction."""
        self._frames.append(frame)
        if len(self._frames) == self._after:
            self._job = self._pool.submit(self._reconstruct, tuple(self._frames))

    def estimates(self) -> tuple[ObjectEstimate, ...]:
        """Wait for the reconstruction, and return its objects; none if it failed or was not started."""
        if self._job is None:
            return ()
        try:
            return tuple(self._job.result())
        except PerceptionError as error:
            logger.debug("no early reconstruction: %s", error)
            return ()
