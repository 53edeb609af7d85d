"""Input for the examples where no path is given: seeded simulated images of a table (extra `sim`)."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import nodeslam


def sample_frames(count: int = 1, width: int = 640, seed: int = 4) -> Iterator[nodeslam.RgbdFrame]:
    """Render a camera moving over a table with a mug, a bowl, a bottle and a can."""
    config = nodeslam.SequenceConfig(
        width=width, height=3 * width // 4, frames=count,
        objects=4, categories=nodeslam.CATEGORIES, spread=0.17, look_at=0.04,
    )  # fmt: skip
    for image in nodeslam.TableSequence(seed, config).render():
        yield image.frame


def sample_scan() -> Path:
    """Write a scan folder of three views, 20 frames apart, with their camera poses."""
    folder = Path(tempfile.mkdtemp(prefix="nodeslam_scan_"))
    nodeslam.write_scan(folder, list(sample_frames(41))[::20])
    return folder


def sample_sequence() -> Iterator[nodeslam.RgbdFrame]:
    """Render a short sequence; only the first frame has its camera pose."""
    for index, frame in enumerate(sample_frames(8, width=320)):
        yield frame if index == 0 else replace(frame, T_world_camera=None)
