"""SLAM on a sequence, frame by frame, for the command and its evaluation."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from perception.errors import InvalidInputError
from perception.inference.shape_model import Decoder
from perception.io.bop_results import PosedImage
from perception.io.recordings.sequence import RgbdSequence, without_pose
from perception.io.recordings.trajectory import Trajectory
from perception.slam.config import SlamConfig
from perception.slam.detection_schedule import DetectionScheduleConfig
from perception.slam.frame_detections import Detect
from perception.slam.frame_result import FrameResult
from perception.slam.relocalise import Relocalisation
from perception.slam.stage_timer import Clock
from perception.slam.system import Slam
from perception.threads import single_threaded_torch
from perception.types import ObjectDetection, RgbdFrame, SupportPlane


@dataclass
class SlamRun:
    """A run in progress; its attributes are valid after every frame.

    Attributes:
        sequence: The sequence.
        slam: The system with map and keyframes.
        results: Results of the frames so far, without unreadable ones.
        images: Frames in which the camera was tracked, with the poses as estimated then.
        warnings: One line for each unreadable frame.
    """

    sequence: RgbdSequence
    slam: Slam
    results: list[FrameResult] = field(default_factory=list)
    images: list[PosedImage] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @staticmethod
    def start(
        sequence: RgbdSequence,
        decoder: Decoder,
        detector: Detect | None,
        config: SlamConfig,
        clock: Clock = time.perf_counter,
    ) -> SlamRun:
        """Prepare a run.

        Args:
            sequence: The sequence; its own detections take precedence over the detector and are used in every
                frame.
            decoder: Shape prior.
            detector: Detector for sequences without detections.
            config: Settings of the system.
            clock: Time in seconds, for the durations of the stages.
        """
        source = _Source(sequence, detector)
        if sequence.entries is not None:
            config = replace(config, detection=DetectionScheduleConfig(max_interval=1))
        run = SlamRun(sequence, Slam(decoder, source, config, clock))
        run._source = source
        return run

    _source: _Source = field(init=False, repr=False)

    def steps(self) -> Iterator[tuple[RgbdFrame, FrameResult]]:
        """Process frame by frame. Torch uses one thread, as objects are processed in parallel."""
        with single_threaded_torch():
            yield from self._steps()
            self.slam.finish()

    def _steps(self) -> Iterator[tuple[RgbdFrame, FrameResult]]:
        for number, frame in self.sequence.frames():
            if isinstance(frame, InvalidInputError):
                self.warnings.append(str(frame))
                continue
            self._source.number = number
            result = self.slam.process(frame)
            self.results.append(result)
            if result.status != "lost":
                self.images.append(PosedImage(number, result.T_world_camera, frame.intrinsics))
            yield frame, result

    def relocalise(self, number: int, frame: RgbdFrame) -> Relocalisation | None:
        """Relocalise a frame of the sequence in the present map, without using its pose."""
        self._source.number = number
        return self.slam.relocalise(without_pose(frame))

    @property
    def trajectory(self) -> Trajectory:
        """Camera pose as estimated at each frame, without frames in which the camera was lost."""
        known = [r for r in self.results if r.status != "lost"]
        return Trajectory.of([r.time for r in known], [r.T_world_camera for r in known])

    def seconds(self, stage: str) -> list[float]:
        """Return the duration of a stage in each frame that had it."""
        return [r.seconds[stage] for r in self.results if stage in r.seconds]

    @property
    def frame_rate(self) -> float:
        """Median tracking rate in frames per second, without detection and mapping."""
        seconds = self.seconds("track")
        return float(1 / np.median(seconds)) if seconds else 0.0

    @property
    def loop_rate(self) -> float:
        """Mean rate of all stages in frames per second, without reading the images."""
        total = sum(sum(r.seconds.values()) for r in self.results)
        return len(self.results) / total if total else 0.0


class _Source:
    """Detections of the current frame: the sequence's own, or the detector's."""

    def __init__(self, sequence: RgbdSequence, detector: Detect | None) -> None:
        self.sequence, self.detector = sequence, detector
        self.number = 0

    def __call__(self, frame: RgbdFrame, plane: SupportPlane) -> list[ObjectDetection]:
        found = self.sequence.detections(self.number, frame)
        if found is None:
            if self.detector is None:
                raise InvalidInputError(
                    f"{self.sequence.path} has no detections.json, and no detector is loaded"
                )
            found = list(self.detector(frame, plane))
        return found
