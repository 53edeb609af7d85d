"""A sequence through the SLAM system, frame by frame: what the command and its evaluation share."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from perception.errors import InvalidInputError
from perception.inference.shape_model import Decoder
from perception.io.detections import encode_detections
from perception.io.recordings.sequence import RgbdSequence, without_pose
from perception.io.recordings.trajectory import Trajectory
from perception.slam.config import SlamConfig
from perception.slam.relocalise import Relocalisation
from perception.slam.system import Clock, Detect, FrameResult, Slam
from perception.types import ObjectDetection, RgbdFrame, SupportPlane


@dataclass
class SlamRun:
    """Runs a sequence; everything collected so far can be read at any moment.

    Attributes:
        sequence: what is run.
        slam: map and keyframes.
        results: of the frames so far; those that could not be read are missing.
        warnings: one line for each unreadable frame.
        detections: of each frame by number, where they are kept, encoded as in ``detections.json``.
    """

    sequence: RgbdSequence
    slam: Slam
    results: list[FrameResult] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    detections: dict[int, list[Any]] = field(default_factory=dict)

    @staticmethod
    def start(
        sequence: RgbdSequence,
        decoder: Decoder,
        detector: Detect | None,
        config: SlamConfig,
        keep_detections: bool = False,
        clock: Clock = time.perf_counter,
    ) -> SlamRun:
        """Ready to run; without detector the sequence must have detections of its own."""
        source = _Source(sequence, detector, keep_detections)
        run = SlamRun(sequence, Slam(decoder, source, config, clock), detections=source.kept)
        run._source = source
        return run

    _source: _Source = field(init=False, repr=False)

    def steps(self) -> Iterator[tuple[RgbdFrame, FrameResult]]:
        """Frame by frame. Torch gets one thread: objects are spread over the cores instead."""
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            yield from self._steps()
        finally:
            torch.set_num_threads(threads)

    def _steps(self) -> Iterator[tuple[RgbdFrame, FrameResult]]:
        for number, frame in self.sequence.frames():
            if isinstance(frame, InvalidInputError):
                self.warnings.append(str(frame))
                continue
            self._source.number = number
            result = self.slam.process(frame)
            self.results.append(result)
            yield frame, result

    def relocalise(self, number: int, frame: RgbdFrame) -> Relocalisation | None:
        """Where a frame of the sequence was taken, by the map as it is now and nothing else."""
        self._source.number = number
        return self.slam.relocalise(without_pose(frame))

    @property
    def trajectory(self) -> Trajectory:
        """The camera's poses as they were known at each frame; frames in which it was lost are left out."""
        known = [r for r in self.results if r.status != "lost"]
        return Trajectory.of([r.time for r in known], [r.T_world_camera for r in known])

    def seconds(self, stage: str) -> list[float]:
        """What a stage took in each frame that had it."""
        return [r.seconds[stage] for r in self.results if stage in r.seconds]

    @property
    def frame_rate(self) -> float:
        """Frames tracked a second, the median, detection and mapping apart."""
        seconds = self.seconds("track")
        return float(1 / np.median(seconds)) if seconds else 0.0


class _Source:
    """Detections of the frame at hand: the sequence's own, or the detector's."""

    def __init__(self, sequence: RgbdSequence, detector: Detect | None, keep: bool) -> None:
        self.sequence, self.detector, self.keep = sequence, detector, keep
        self.number = 0
        self.kept: dict[int, list[Any]] = {}

    def __call__(self, frame: RgbdFrame, plane: SupportPlane) -> list[ObjectDetection]:
        found = self.sequence.detections(self.number, frame)
        if found is None:
            if self.detector is None:
                raise InvalidInputError(
                    f"{self.sequence.path} has no detections.json, and no detector is loaded"
                )
            found = list(self.detector(frame, plane))
        if self.keep:
            self.kept[self.number] = encode_detections(self.number, found)
        return found
