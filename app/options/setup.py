"""Options of the commands that examine this machine, and arms."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from app.options.common import CommonOptions


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(CommonOptions):
    """Check this machine (OpenGL, CUDA, weights, versions) or an arm, with a remedy for what is missing."""

    robot: Annotated[str | None, arg(metavar="NAME|FILE", help_behavior_hint="default: this machine")] = None
    """Examine an arm instead: robot file, MJCF or name of an included arm; draws it into robot.png."""


@dataclass(frozen=True, kw_only=True)
class RobotOptions(CommonOptions):
    """Write a robot file from the models of an arm and its hand."""

    action: Positional[Literal["init"]]
    """init: write the file to --out, or robot.toml, and say what was assumed."""
    arm: Positional[Path]
    """MJCF of the arm."""
    hand: Annotated[Path | None, arg(metavar="HAND.xml", help_behavior_hint="default: part of ARM")] = None
    """MJCF of the hand, if it has a file of its own."""
    mount: Annotated[str, arg(metavar="SITE", help_behavior_hint="default: none")] = ""
    """Site or body of the arm that carries the hand."""
    body: Annotated[str, arg(metavar="NAME", help_behavior_hint="default: the first")] = ""
    """Body at which the arm begins, in a file with more than that."""
