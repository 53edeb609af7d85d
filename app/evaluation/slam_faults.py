"""Simulated faults of sensor and detector: dropped frames, missing depth, flickering masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.options import SlamFault
from perception.io.recordings.sequence import RgbdSequence
from perception.types import ObjectDetection, RgbdFrame

MOVED_AT = 0.4  # share of the sequence after which an object is displaced
_DARK_FROM, _DARK_SECONDS = 0.4, 1.0
_DROPPED, _GAP = 0.2, 5  # share of dropped frames, and length of one gap in frames
_FLICKER = 0.25  # share of missing masks


def held(frames: Sequence[RgbdFrame]) -> RgbdSequence:
    """Return a sequence of frames in memory, numbered from 0."""
    return RgbdSequence(Path("memory"), range(len(frames)), lambda number: frames[number])


def with_fault(frames: Sequence[RgbdFrame], fault: SlamFault, rng: np.random.Generator) -> RgbdSequence:
    """Return the sequence with a sensor fault; faults of the masks or the scene leave it unchanged.

    Args:
        frames: Frames at a constant rate.
        fault: Kind of fault.
        rng: Determines which frames are dropped.
    """
    sequence, n = held(frames), len(frames)
    if fault == "dropped":
        missing = rng.random(n) < _DROPPED
        begin = n // 2
        missing[begin : begin + _GAP] = True
        missing[:3] = False
        return replace(sequence, ids=[int(k) for k in np.flatnonzero(~missing)])
    if fault == "dark":
        begin = int(_DARK_FROM * n)
        end = frames[begin].time + _DARK_SECONDS
        seen = [_black(f) if k >= begin and f.time < end else f for k, f in enumerate(frames)]
        return held(seen)
    return sequence


def _black(frame: RgbdFrame) -> RgbdFrame:
    return replace(frame, depth=np.zeros_like(frame.depth))


def flickering(detections: Sequence[ObjectDetection], rng: np.random.Generator) -> list[ObjectDetection]:
    """Drop each detection with a fixed probability."""
    return [found for found in detections if rng.random() >= _FLICKER]
