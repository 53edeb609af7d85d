"""The command line: options in, exit code out.

0 done and successful, 1 ran but the task failed, 2 bad usage or input (one line on standard
error), 130 interrupted.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import Annotated, Any

import tyro

from app.errors import AppError, UsageError
from app.options import COMMANDS, CellOptions, CommonOptions
from app.screen import Screen
from perception.errors import install_hint

DESCRIPTION = "Object-level RGB-D SLAM for robot manipulation: reconstruct whole objects, pack or sort them."
DONE, TASK_FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

# Imported on use, so that each command loads only what it needs.
HANDLERS = {
    "pack": "app.task.command",
    "sort": "app.task.command",
    "scan": "app.task.scan",
    "reconstruct": "app.reconstruct",
    "convert": "app.convert",
    "ar": "app.ar.command",
    "export": "app.export.command",
    "slam": "app.slam.command",
    "train": "app.training.command",
    "evaluate": "app.evaluation.command",
    "bench": "app.benchmarks.command",
    "view": "app.viewer.command",
    "doctor": "app.doctor",
}

# Optional extra that provides a library.
_SIMULATOR = ("mujoco", "mjviser", "mink", "daqp", "ruckig", "coacd")
EXTRA_OF = dict.fromkeys(_SIMULATOR, "sim") | {"tensorboard": "train", "transformers": "hf"}


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code."""
    try:
        options = parse(arguments)
        check(options)
    except AppError as error:
        return _complain(str(error))
    except SystemExit as end:  # --help
        return int(end.code or 0)
    command = next(name for name, kind in COMMANDS.items() if type(options) is kind)
    screen = Screen(quiet=options.quiet or options.json, json=options.json)
    level = logging.ERROR if options.quiet else logging.WARNING
    logging.basicConfig(level=level, format="nodeslam: %(levelname)s: %(message)s", stream=sys.stderr)
    try:
        with _stdout_reserved(options.json):
            report = _handler(command)(options, screen)
    except KeyboardInterrupt:
        return _complain("interrupted; finished results are kept", INTERRUPTED)
    except _input_errors() as error:
        return _complain(str(error))
    except ModuleNotFoundError as error:
        extra = EXTRA_OF.get((error.name or "").split(".")[0])
        if extra is None:
            raise
        return _complain(f"{command} needs {error.name}: {install_hint(extra)}")
    if options.json:
        sys.stdout.write(report.to_json() + "\n")
    return DONE if report.success else TASK_FAILED


def parse(arguments: Sequence[str]) -> CommonOptions:
    """Parse a command line.

    Raises:
        UsageError: The arguments are invalid; the message is one line.
        SystemExit: Help was requested and printed.
    """
    kinds: list[Any] = [
        Annotated[kind, tyro.conf.subcommand(name, prefix_name=False)] for name, kind in COMMANDS.items()
    ]
    config = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
    commands: Any = reduce(lambda union, kind: union | kind, kinds)
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(commands, prog="nodeslam", description=DESCRIPTION, args=arguments, config=config)
    except SystemExit as end:
        if not end.code:
            raise
        raise UsageError(_one_line(errors.getvalue())) from None


def check(options: CommonOptions) -> None:
    """Validate values before anything heavy is loaded.

    Raises:
        UsageError: A value is invalid; the message is one line.
    """
    if isinstance(options, CellOptions) and getattr(options, "what", None) != "reconstruction":
        from app.task.cell import check_options

        check_options(options)
    for name in ("episodes", "workers", "epochs", "repeats", "drops", "images"):
        value = getattr(options, name, None)
        if value is not None and value < 1:
            raise UsageError(f"--{name} {value} must be at least 1")


def _one_line(boxed: str) -> str:
    """Return the message in tyro's framed error: above its first rule, or below the title's rule in ASCII."""
    lines = [re.sub(r"[│╭╮╰╯]", "", line).strip() for line in boxed.splitlines()]
    text = "\n".join(line for line in lines if line and not line.startswith("─ "))  # without the title
    above, *below = re.split("─+|-{5,}", text)
    message = " ".join((above if "│" in boxed or not below else below[0]).split()).rstrip(".")
    suggestion = re.search(r"Perhaps you meant\S*\s+(--[\w-]+)", text)
    if suggestion:
        message += f" (did you mean {suggestion.group(1)}?)"
    page = re.search(r"nodeslam[\w ]* --help", boxed)
    return f"{message}; see {page.group() if page else 'nodeslam --help'}"


def _handler(command: str) -> Callable[[Any, Screen], Any]:
    return importlib.import_module(HANDLERS[command]).run


def _input_errors() -> tuple[type[Exception], ...]:
    """Return the exception types that mean invalid usage or input, of the packages loaded so far."""
    kinds: list[type[Exception]] = [AppError]
    for module, names in {
        "perception.errors": ("PerceptionError",),
        "sim_assets.errors": ("SimAssetsError",),
        "sim_assets.rendering.headless": ("GraphicsError",),
    }.items():
        if module in sys.modules:
            kinds += [getattr(sys.modules[module], name) for name in names]
    return tuple(kinds)


def _complain(message: str, code: int = BAD_INPUT) -> int:
    sys.stderr.write(f"nodeslam: {' '.join(message.split())}\n")
    return code


@contextlib.contextmanager
def _stdout_reserved(reserve: bool) -> Iterator[None]:
    """Redirect the standard output of libraries, including native ones, to standard error."""
    if not reserve:
        yield
        return
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
