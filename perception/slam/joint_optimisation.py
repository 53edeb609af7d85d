"""Joint optimisation of the newest keyframe's window, applied to the map a fixed number of frames later."""

from __future__ import annotations

from functools import partial

import numpy as np
from jaxtyping import Float

from perception.inference.shape_model import Decoder
from perception.slam.bundle_adjustment import optimise_jointly
from perception.slam.bundle_window import BundleResult
from perception.slam.config import SlamConfig
from perception.slam.joint_worker import DelayedJob
from perception.slam.keyframes import Keyframe
from perception.slam.mapping import Mapper


class JointOptimisation:
    """At most one optimisation in progress."""

    def __init__(self, decoder: Decoder, config: SlamConfig) -> None:
        self._decoder, self._config = decoder, config
        self._job: DelayedJob[BundleResult] = DelayedJob(config.concurrent)

    @property
    def in_progress(self) -> bool:
        """Whether an optimisation was started and is not applied yet."""
        return self._job.due is not None

    def is_due(self, number: int) -> bool:
        """Return whether the optimisation in progress is to be applied at a frame."""
        return self._job.due is not None and number >= self._job.due

    def start(self, mapper: Mapper, key: Keyframe, at_once: bool) -> None:
        """Start with the window of a new keyframe; ``at_once`` makes it due at the keyframe itself."""
        due = key.number if at_once else key.number + self._config.joint_delay
        window, settings = mapper.window_of(key), self._config.bundle_adjustment
        self._job.start(partial(optimise_jointly, window, self._decoder, settings), due)

    def apply(self, mapper: Mapper) -> Float[np.ndarray, "4 4"]:
        """Wait for the result, apply it and return the correction of the newest keyframe's pose."""
        return mapper.apply(self._job.take())
