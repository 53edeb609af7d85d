"""``nodeslam robot init``: a robot file from models."""

from __future__ import annotations

import time
from pathlib import Path

from rich.markup import escape

from app.errors import UsageError
from app.options import RobotOptions
from app.robots.draft import draft_robot
from app.runs.report import Report
from app.screen import Screen

FILE = "robot.toml"


def run(options: RobotOptions, screen: Screen) -> Report:
    """Draft the robot file and write it; an existing file is not overwritten.

    Raises:
        UsageError: the models are unusable, or the file exists.
    """
    begin = time.perf_counter()
    target = Path(FILE) if options.out is None else options.out
    target = target / FILE if target.suffix != ".toml" else target
    if target.exists():
        raise UsageError(f"{target} exists: remove it, or give another file with --out")
    for name, path in (("ARM", options.arm), ("--hand", options.hand)):
        if path is not None and not path.is_file():
            raise UsageError(f"{name} {path} is no file: give an MJCF model (.xml)")
    if options.hand is not None and not options.mount:
        raise UsageError("--hand needs --mount SITE: the site or body of the arm that carries the hand")
    with screen.stage("Measuring arm and hand"):
        draft = draft_robot(options.arm, target.parent, options.hand, options.mount, options.body)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(draft.text, encoding="utf-8")
    lines = [f"{target} written; assumed:", *(f"- {line}" for line in draft.assumptions)]
    screen.show(escape("\n".join(lines)))
    return Report(
        command="robot",
        seed=options.seed,
        success=True,
        reason=f"{target} written",
        timings={"total": time.perf_counter() - begin},
        metrics={"file": str(target), "assumptions": list(draft.assumptions)},
    )
