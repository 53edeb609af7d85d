"""The command line: options in, exit code out.

0 done and successful, 1 ran but the task failed, 2 bad usage or input, 130 interrupted, 143 terminated,
129 terminal closed.
Whatever ends a command early is one line on standard error; the traceback of an unexpected error is in a log
file.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import os
import re
import resource
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from pathlib import Path
from typing import Annotated, Any

import tyro

from app import interrupts
from app.errors import AppError, ProblemsError, UsageError
from app.failures import BAD_INPUT, TASK_FAILED, failure_of, one_line, write_log
from app.imports import without_collection
from app.options import COMMANDS, CellOptions, CommonOptions
from app.screen import Screen

DESCRIPTION = "Object-level RGB-D SLAM for robot manipulation: reconstruct whole objects, pack or sort them."
DONE = 0

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
    "collect": "app.collect.command",
    "bench": "app.benchmarks.command",
    "view": "app.viewer.command",
    "doctor": "app.doctor",
    "robot": "app.robots.command",
    "serve": "app.serve",
}

# Values of MUJOCO_GL that MuJoCo accepts.
GL_BACKENDS = ("", "egl", "osmesa", "glfw", "glx", "enable", "enabled", "on", "true", "1",
               "disable", "disabled", "off", "false", "0")  # fmt: skip
# Values of PYOPENGL_PLATFORM that PyOpenGL accepts on Linux.
GL_PLATFORMS = ("", "egl", "osmesa", "glx", "x11", "wayland", "linux")
MIN_ADDRESS_SPACE = 2**30  # [bytes]: with much less, OpenBLAS never returns from its initialisation
MIN_STACK = 2**19  # [bytes]: with half of it, libraries crash
MAX_SEED = 2**64 - 1
MIN_COLUMNS = 40  # of the help: in a few columns, laying it out takes minutes
# Ranges of counts: what is asked for is listed in memory, and workers are processes of 1 GB each.
COUNTS = {
    "workers": (1, 256), "episodes": (1, 10**6), "images": (1, 10**6), "short_runs": (0, 10**6),
    "epochs": (1, 10**6), "repeats": (1, 10**4), "drops": (1, 1000),
    "scenes": (0, 10**6), "frames": (0, 10**6),
}  # fmt: skip
MAX_WORKERS = COUNTS["workers"][1]
MAX_SECONDS = 600.0  # of an AR video
MAX_STAGE_LIMIT = 1e7  # [s]


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code."""
    try:
        options = parse(arguments)
        check(options)
    except ProblemsError as error:
        return _complain(*error.problems)
    except AppError as error:
        return _complain(str(error))
    except SystemExit as end:  # --help
        return int(end.code or 0)
    except BrokenPipeError:  # the reader of the help has ended, such as `head`
        return DONE
    except OSError as error:  # a path that cannot be examined
        return _complain(failure_of(error, "nodeslam").message)
    command = next(name for name, kind in COMMANDS.items() if type(options) is kind)
    screen = Screen(
        quiet=options.quiet or options.json, json=options.json, stage_limit=_stage_limit(command, options)
    )
    level = logging.ERROR if options.quiet else logging.WARNING
    logging.basicConfig(level=level, format="nodeslam: %(levelname)s: %(message)s", stream=sys.stderr)
    try:
        with _stdout_reserved(options.json):
            handler = _handler(command)
            interrupts.raise_if(lambda: command == "view" or bool(_run_folders("open_folders")))
            report = handler(options, screen)
            _run_folders("finish_all", complete=True)
        if options.json:
            with contextlib.suppress(BrokenPipeError):  # the reader has ended, such as `head`
                sys.stdout.write(report.to_json() + "\n")
                sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        interrupts.ignore()
        return _end(error, command, options.debug)
    return DONE if report.success else TASK_FAILED


def _end(error: BaseException, command: str, debug: bool) -> int:
    """Keep what is finished, report why the command ended, and return its exit code."""
    try:
        folders = _run_folders("finish_all", complete=False)
    except OSError:  # full disk: the next run in the folder clears up
        folders = []
    if debug:
        traceback.print_exception(error)
    if isinstance(error, KeyboardInterrupt) or interrupts.was_interrupted():
        replaced = _run_folders("replaced_runs", folders=folders)
        kept = "".join(f"; the run before is in {path}" for path in replaced)
        return _complain(f"interrupted; finished results are kept{kept}", code=interrupts.exit_code())
    if isinstance(error, ProblemsError):
        return _complain(*error.problems)
    assert isinstance(error, Exception)
    failure = failure_of(error, command)
    if failure.expected:
        return _complain(failure.message, code=failure.code)
    log = write_log(error, folders[0] if folders else None)
    hint = f"; traceback in {log}" if log else "; --debug shows the traceback"
    return _complain(failure.message + hint, code=failure.code)


def parse(arguments: Sequence[str]) -> CommonOptions:
    """Parse a command line.

    Raises:
        UsageError: The arguments are invalid; the message is one line.
        SystemExit: Help was requested and printed.
    """
    if list(arguments) == ["--version"]:
        from app.runs.report import package_version

        sys.stdout.write(f"nodeslam {package_version()}\n")
        raise SystemExit(DONE)
    empty = next((a for a in arguments if re.fullmatch(r"(--[\w-]+=)?", a)), None)
    if empty is not None:
        raise UsageError(f"argument {empty!r} is empty: omit it, or check the shell variable it was made of")
    # The shell leaves it in --out=~/runs, which would make a folder named ~.
    arguments = [re.sub(r"^(--[\w-]+=)?(~(?:/.*)?)$", _at_home, a, flags=re.DOTALL) for a in arguments]
    kinds: list[Any] = [
        Annotated[kind, tyro.conf.subcommand(name, prefix_name=False)] for name, kind in COMMANDS.items()
    ]
    config = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
    commands: Any = reduce(lambda union, kind: union | kind, kinds)
    errors = io.StringIO()
    if os.environ.get("COLUMNS", "").isdecimal() and int(os.environ["COLUMNS"][:9]) < MIN_COLUMNS:
        os.environ["COLUMNS"] = str(MIN_COLUMNS)
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(commands, prog="nodeslam", description=DESCRIPTION, args=arguments, config=config)
    except SystemExit as end:
        if not end.code:
            raise
        raise UsageError(_one_line(errors.getvalue())) from None


def _at_home(argument: re.Match[str]) -> str:
    """Return an argument with the home directory, if there is one, in place of the tilde of its path."""
    option, path = argument.groups()
    return (option or "") + os.path.expanduser(path)


def check(options: CommonOptions) -> None:
    """Validate values before anything heavy is loaded.

    Raises:
        UsageError: A value is invalid; the message is one line.
    """
    _check_environment()
    for circumstance, names in options.without_effect().items():
        for name in sorted(options.changed().intersection(names)):
            raise UsageError(f"--{name.replace('_', '-')} has no effect {circumstance}: omit it")
    if options.device == "cuda":  # some commands have no use for it, and would not say that there is none
        from perception.errors import InvalidInputError
        from perception.pipeline import resolve_device

        try:
            resolve_device(options.device)
        except InvalidInputError as error:
            raise UsageError(str(error)) from None
    if isinstance(options, CellOptions) and getattr(options, "what", None) != "reconstruction":
        from app.task.cell import check_options

        check_options(options)
    if not 0 <= options.seed <= MAX_SEED:
        raise UsageError(f"--seed {options.seed} must be in 0..2**64 - 1")
    seconds = getattr(options, "seconds", None)
    if seconds is not None and not 0 < seconds <= MAX_SECONDS:
        raise UsageError(f"--seconds {seconds:g} must be more than 0 and at most {MAX_SECONDS:g}")
    if not 0 <= options.stage_limit <= MAX_STAGE_LIMIT:
        raise UsageError(f"--stage-limit {options.stage_limit:g} must be in 0..{MAX_STAGE_LIMIT:g}")
    tolerance = getattr(options, "tolerance", 0.0)
    if not 0 <= tolerance < 1:
        raise UsageError(f"--tolerance {tolerance:g} must be at least 0 and below 1")
    growth = getattr(options, "growth_workers", ())
    if not all(1 <= workers <= MAX_WORKERS for workers in growth) or len(set(growth)) < len(growth):
        raise UsageError(f"--growth-workers takes different numbers from 1 to {MAX_WORKERS}")
    port = getattr(options, "port", None)
    if port is not None and not 0 <= port < 2**16:
        raise UsageError(f"--port {port} must be in 0..65535")
    for name, (low, high) in COUNTS.items():
        value = getattr(options, name, None)
        if value is not None and not low <= value <= high:
            raise UsageError(f"--{name.replace('_', '-')} {value} must be in {low}..{high}")


def _check_environment() -> None:
    """Raise UsageError for environment variables and limits with which no command works."""
    backend = os.environ.get("MUJOCO_GL", "").lower().strip()
    if backend not in GL_BACKENDS:
        raise UsageError(f"MUJOCO_GL={backend} is no OpenGL backend: unset it, or set it to egl or osmesa")
    platform = os.environ.get("PYOPENGL_PLATFORM", "")
    if platform not in GL_PLATFORMS:
        raise UsageError(f"PYOPENGL_PLATFORM={platform} is no platform of PyOpenGL: unset it")
    gpu = os.environ.get("MUJOCO_EGL_DEVICE_ID", "0")
    if not re.fullmatch(r"\d{1,9}", gpu, re.ASCII):
        raise UsageError(f"MUJOCO_EGL_DEVICE_ID={gpu} is no number of a GPU: unset it")
    threads = os.environ.get("OMP_NUM_THREADS", "1")
    if not re.fullmatch(
        r"\s*[1-9]\d{0,4}\s*(,\s*[1-9]\d{0,4}\s*)*", threads
    ):  # OpenMP prints a line of its own
        raise UsageError(f"OMP_NUM_THREADS={threads} is no number of threads: unset it")
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "0")
    if not re.fullmatch(r"\d{1,18}", epoch, re.ASCII):  # numpy reads it on import
        raise UsageError(f"SOURCE_DATE_EPOCH={epoch} is no time in seconds: unset it")
    try:
        Path.cwd()
    except FileNotFoundError:  # libraries cannot be loaded from there
        raise UsageError("the working directory was removed: change to another one") from None
    address_space, _ = resource.getrlimit(resource.RLIMIT_AS)
    if address_space != resource.RLIM_INFINITY and address_space < MIN_ADDRESS_SPACE:
        limit = f"{address_space / 2**20:.0f} MB of address space (ulimit -v)"
        raise UsageError(f"{limit} are too little: allow {MIN_ADDRESS_SPACE / 2**20:.0f} MB or more")
    stack, _ = resource.getrlimit(resource.RLIMIT_STACK)
    if stack != resource.RLIM_INFINITY and stack < MIN_STACK:
        limit = f"{stack / 2**10:.0f} kB of stack (ulimit -s)"
        raise UsageError(f"{limit} are too little: allow {MIN_STACK / 2**10:.0f} kB or more")


def _one_line(boxed: str) -> str:
    """Return the message in tyro's framed error: above its first rule, or below the title's rule in ASCII."""
    lines = [re.sub(r"[│╭╮╰╯]", "", line).strip() for line in boxed.splitlines()]
    text = "\n".join(line for line in lines if line and not line.startswith("─ "))  # without the title
    above, *below = re.split("─+|-{5,}", text)
    message = " ".join((above if "│" in boxed or not below else below[0]).split()).rstrip(".")
    value = re.fullmatch(r"Error parsing (--[\w-]+): .*?\b(int|float)\b.*: '(.*?)'.*", message)
    if value:
        option, kind, given = value.groups()
        message = f"{option} takes {'a whole number' if kind == 'int' else 'a number'}, not '{given}'"
    suggestion = re.search(r"Perhaps you meant\S*\s+(--[\w-]+)", text)
    if suggestion:
        message += f" (did you mean {suggestion.group(1)}?)"
    page = re.search(r"nodeslam[\w ]* --help", boxed)
    return f"{message}; see {page.group() if page else 'nodeslam --help'}"


def _stage_limit(command: str, options: CommonOptions) -> float:
    """Return the time limit of stages; a run in the viewer can be paused, and an epoch may take hours."""
    unlimited = command in ("train", "view") or getattr(options, "view", False)
    return 0.0 if unlimited else options.stage_limit


def _handler(command: str) -> Callable[[Any, Screen], Any]:
    with without_collection():
        return importlib.import_module(HANDLERS[command]).run


def _run_folders(function: str, **arguments: Any) -> list[Path]:
    """Call a function of ``app.runs.run_folder``, which is loaded only by the commands that write a run."""
    module = sys.modules.get("app.runs.run_folder")
    return [] if module is None else getattr(module, function)(**arguments)


def _complain(*problems: str, code: int = BAD_INPUT) -> int:
    """Print one line; further problems of the same input follow on indented lines."""
    with contextlib.suppress(OSError):  # nobody reads standard error
        sys.stderr.write("nodeslam: " + "\n  ".join(map(one_line, problems)) + "\n")
        sys.stderr.flush()
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
