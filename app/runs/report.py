"""The report of a run: what happened, how long it took, and why something failed."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np


def package_version() -> str:
    """The installed version of this package."""
    try:
        return version("nodeslam")
    except PackageNotFoundError:
        return "unknown"


@dataclass(frozen=True)
class ObjectReport:
    """What became of one object.

    Attributes:
        id: its id in the object map, or, with a minus, of an object on the table that was never seen.
        category: its class, as perceived where it was perceived.
        placed: whether it stands where the task wants it; None where that was not judged.
        error_position: horizontal distance in [m] from where the plan wanted it.
        error_tilt: angle in [rad] between its axis and the vertical.
        attempts: grasps tried.
        reason: why not, in one line; empty where placed.
        details: more figures, by name.
    """

    id: int
    category: str
    placed: bool | None = None
    error_position: float | None = None
    error_tilt: float | None = None
    attempts: int = 0
    reason: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        fixed = {key: getattr(self, key) for key in self.__dataclass_fields__ if key != "details"}
        return fixed | dict(self.details)


@dataclass(frozen=True)
class Report:
    """``report.json``.

    Attributes:
        command: name of the command.
        seed: its seed.
        success: whether the task was done.
        reason: one line why not, or what was achieved.
        timings: wall seconds of each stage and ``total``.
        objects: one entry for each object.
        metrics: figures of the command; lengths in [m], ratios in 0..1.
        warnings: what went wrong without stopping the command.
        settings: the options that were in force.
    """

    command: str
    seed: int
    success: bool = False
    reason: str = ""
    timings: Mapping[str, float] = field(default_factory=dict)
    objects: Sequence[ObjectReport] = ()
    metrics: Mapping[str, Any] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """The report as plain values; numbers that JSON has no word for become null."""
        return _plain(
            {
                "command": self.command,
                "seed": self.seed,
                "version": package_version(),
                "success": self.success,
                "reason": self.reason,
                "timings": {stage: round(seconds, 3) for stage, seconds in self.timings.items()},
                "objects": [entry.as_json() for entry in self.objects],
                "metrics": dict(self.metrics),
                "warnings": list(self.warnings),
                "settings": dict(self.settings),
            }
        )

    def to_json(self) -> str:
        return json.dumps(self.as_json(), indent=1)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
