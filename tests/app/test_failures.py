"""One line for each exception that ends a command."""

import errno
import os
import resource
import sys
from pathlib import Path

import pytest

from app.errors import StalledError, UsageError
from app.failures import LOG_FILE, LONGEST, Failure, failure_of, one_line, write_log
from manipulation.errors import PlanningError, RobotError
from manipulation.remote.calibration import CalibrationError
from perception.errors import InvalidInputError

EXPECTED = {
    "usage": (UsageError("--seed is wrong"), Failure("--seed is wrong")),
    "input": (InvalidInputError("x is damaged"), Failure("x is damaged")),
    "stalled": (StalledError("Planning: no progress"), Failure("Planning: no progress", 1, expected=False)),
    "no plan": (PlanningError("no viewpoint"), Failure("no viewpoint")),
    "calibration": (CalibrationError("a.toml: old"), Failure("a.toml: old")),
    "robot": (RobotError("the arm stopped"), Failure("the arm stopped", 1)),
    "extra": (
        ModuleNotFoundError("No module named 'mujoco.egl'", name="mujoco.egl"),
        Failure("pack needs mujoco.egl: pip install 'nodeslam[sim]'"),
    ),
    "full disk": (
        OSError(errno.ENOSPC, "No space left on device", "/data/x"),
        Failure(
            "/data/x: No space left on device; free some space or give --out on another disk",
            2,
            expected=False,
        ),
    ),
    "no remedy": (OSError(errno.EIO, "Input/output error"), Failure("Input/output error", 2, expected=False)),
    "memory": (
        MemoryError(),
        Failure("pack ran out of memory: give it smaller input or more memory", 2, expected=False),
    ),
    "memory for libraries": (
        ImportError("libtorch_cpu.so: failed to map segment from shared object"),
        Failure("pack ran out of memory: give it smaller input or more memory", 2, expected=False),
    ),
    "memory of torch": (
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
        Failure("pack ran out of memory: give it smaller input or more memory", 2, expected=False),
    ),
    "bug": (KeyError("x"), Failure("pack failed unexpectedly: KeyError: 'x'", 1, expected=False)),
    "silent bug": (AssertionError(), Failure("pack failed unexpectedly: AssertionError", 1, expected=False)),
    "unknown module": (
        ModuleNotFoundError("No module named 'foo'", name="foo"),
        Failure("pack failed unexpectedly: ModuleNotFoundError: No module named 'foo'", 1, expected=False),
    ),
}


@pytest.mark.parametrize("error, failure", EXPECTED.values(), ids=EXPECTED)
def test_an_exception_is_described(error, failure):
    found = failure_of(error, "pack")
    if "[sim]" in failure.message:
        assert (
            found.message.startswith("pack needs mujoco.egl: ") and "sim" in found.message and found.expected
        )
    else:
        assert found == failure


def raised():
    try:
        raise ValueError("boom \ud800")
    except ValueError as error:
        return error


def test_the_traceback_is_written_to_the_run_folder(tmp_path):
    assert write_log(raised(), tmp_path) == tmp_path / LOG_FILE
    text = (tmp_path / LOG_FILE).read_text()
    assert text.startswith("Traceback") and "in raised" in text and "ValueError: boom" in text


@pytest.mark.parametrize("folder", [None, Path("/proc/nowhere")])
def test_without_a_run_folder_the_traceback_is_in_a_temporary_file(tmp_path, monkeypatch, folder):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    path = write_log(raised(), folder)
    assert path is not None and path.parent == tmp_path and "boom" in path.read_text()


def test_without_any_place_there_is_no_log(monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", "/proc/nowhere")
    assert write_log(raised(), None) is None


def test_a_line_is_printable_and_short():
    assert one_line("a\n  b\tc") == "a b c"
    assert one_line("\x1b[31mred\x07 ü 椅") == "\\x1b[31mred\\x07 ü 椅"
    assert one_line(os.fsdecode(b"\xff")) == "\\udcff"
    assert one_line("x" * LONGEST) == "x" * LONGEST
    short = one_line("begin" + "x" * 9000 + "end")
    assert len(short) <= LONGEST and short.startswith("begin") and short.endswith("end") and " ... " in short


def test_errors_of_packages_that_are_not_loaded_are_no_problem(monkeypatch):
    monkeypatch.delitem(sys.modules, "sim_assets.errors", raising=False)
    assert failure_of(UsageError("x"), "pack") == Failure("x")


def test_an_opengl_backend_that_does_not_work_is_named(monkeypatch):
    def raised_in(filename, message="division by zero"):
        try:
            exec(compile(f"raise RuntimeError({message!r})", filename, "exec"), {})
        except RuntimeError as error:
            return error

    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    found = failure_of(raised_in("site-packages/OpenGL/raw/GL/_errors.py"), "scan")
    assert found.message == "MUJOCO_GL=osmesa does not work on this machine (division by zero): unset it"
    assert found.code == 2 and not found.expected
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", "9")
    other = failure_of(
        raised_in("site-packages/OpenGL/x.py", "MUJOCO_EGL_DEVICE_ID must be 0, got 9"), "scan"
    )
    assert other.message.startswith("MUJOCO_EGL_DEVICE_ID=9 does not work on this machine (MUJOCO_EGL")
    assert "failed unexpectedly" in failure_of(raised_in("somewhere/else.py"), "scan").message
    monkeypatch.delenv("MUJOCO_GL")
    assert "failed unexpectedly" in failure_of(raised_in("mujoco/osmesa/gl_context.py"), "scan").message


def test_a_limit_of_the_address_space_is_named_as_the_likely_cause(monkeypatch):
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (2**30,) * 2)
    found = failure_of(RuntimeError("cannot load x.so"), "scan")
    assert found.code == 2 and not found.expected
    assert found.message == (
        "scan failed (RuntimeError: cannot load x.so), perhaps for the 1024 MB of address space that it was"
        " given (ulimit -v): allow more"
    )
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (resource.RLIM_INFINITY,) * 2)
    assert failure_of(RuntimeError("x"), "scan").message == "scan failed unexpectedly: RuntimeError: x"
