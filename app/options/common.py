"""Options of every command, and the choices that several commands share."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal, Optional

from tyro.conf import arg

Device = Literal["auto", "cpu", "cuda"]
Task = Literal["pack", "sort"]
# Options that do not change what is simulated.
NOT_SETTINGS = {"seed", "out", "quiet", "json", "debug", "stage_limit"}


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """Options of every command."""

    seed: int = 0
    """Seed of all random numbers."""
    out: Annotated[
        Optional[Path],  # noqa: UP045 -- tyro checks Path | None with typeguard, which takes 50 ms to import
        arg(metavar="DIR", help_behavior_hint="default: runs/<time>_<command>_seed<N>"),
    ] = None
    """Run folder to write to."""
    device: Device = "auto"
    """Device for networks and optimisation; auto selects CUDA if available."""
    quiet: bool = False
    """Print neither progress nor tables."""
    json: bool = False
    """Print the report as JSON, and nothing else, on standard output."""
    debug: bool = False
    """Print the traceback of any error on standard error."""
    stage_limit: Annotated[float, arg(metavar="SECONDS")] = 3600.0
    """Time without progress after which a stage is ended; 0 for none. Training and viewer have no limit."""

    def without_effect(self) -> Mapping[str, Collection[str]]:
        """Return names of options that the others leave without effect, by the reason for it."""
        return {}

    def changed(self) -> set[str]:
        """Return the names of the options that do not have their default."""
        return {f.name for f in fields(self) if getattr(self, f.name) != f.default}
