"""Processes and machines that a training may use; its results do not depend on them but for rounding."""

from __future__ import annotations

from dataclasses import dataclass

from app.jobs import Workers


@dataclass(frozen=True)
class Resources:
    """Where a training runs.

    Attributes:
        workers: Where its data are generated, with equal results.
        processes: Number of processes that share each batch of the optimisation, with equal results but for
            rounding.
    """

    workers: Workers = Workers()
    processes: int = 1
