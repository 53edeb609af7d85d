"""Report of a run: outcome, timings, and reasons of failures."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np


def package_version() -> str:
    """Return the installed version of this package."""
    try:
        return version("nodeslam")
    except PackageNotFoundError:
        return "unknown"


@dataclass(frozen=True)
class ObjectReport:
    """Outcome of one object.

    Attributes:
        id: Id in the object map; negative for an object that was not perceived.
        category: True class.
        placed: Whether the success criteria hold; None if they were not evaluated.
        error_position: Horizontal distance from the planned position, in metres.
        error_tilt: Angle between the object's axis and the vertical, in radians.
        attempts: Number of grasp attempts.
        reason: Reason of the failure in one line; empty if placed.
        details: Further figures by name.
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
    """Content of ``report.json``.

    Attributes:
        command: Name of the command.
        seed: Seed of the run.
        success: Whether the task succeeded.
        reason: One-line summary, or reason of the failure.
        timings: Wall time of each stage and ``total``, in seconds.
        objects: Outcome of each object.
        metrics: Figures of the command; lengths in metres, ratios in 0..1.
        warnings: Problems that did not end the command.
        settings: Options that determine the run.
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
        """Return the report as plain values; NaN and infinity become null."""
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


def moved_things(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return how many things of no class the robot moved, which it must not touch; empty if it moved none.

    ``rows`` are those of the metric "unknown", one for each thing.
    """
    count = sum(bool(row["moved"]) for row in rows)
    return f"{count} thing{'s' * (count > 1)} of no class moved" if count else ""


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
