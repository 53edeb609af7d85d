"""What a real camera, detector or hand does to a sequence: frames missing, depth black, masks flickering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.options import SlamFault
from perception.io.recordings.sequence import RgbdSequence
from perception.types import ObjectDetection, RgbdFrame

MOVED_AT = 0.4  # share of the sequence after which a hand moves an object
_DARK_FROM, _DARK_SECONDS = 0.4, 1.0
_DROPPED, _GAP = 0.2, 5  # share of the frames that are missing, and how many in a row once
_FLICKER = 0.25  # share of the masks that are missing


def held(frames: Sequence[RgbdFrame]) -> RgbdSequence:
    """Frames in memory, numbered from 0."""
    return RgbdSequence(Path("memory"), range(len(frames)), lambda number: frames[number])


def with_fault(frames: Sequence[RgbdFrame], fault: SlamFault, rng: np.random.Generator) -> RgbdSequence:
    """The frames as a faulty sensor gives them; masks and moved objects are others' business.

    Args:
        frames: of a sequence at an even rate.
        fault: what goes wrong.
        rng: which frames are missing.
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
    """Every mask is missing now and then."""
    return [found for found in detections if rng.random() >= _FLICKER]
