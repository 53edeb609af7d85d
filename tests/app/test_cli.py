"""Exit codes and what stands on which stream."""

import contextlib
import errno
import json
import os
import re
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from app import cli
from app.cli import parse, run
from app.errors import UsageError
from app.options import BenchOptions, DoctorOptions, ScanOptions
from app.runs.report import ObjectReport, Report
from app.runs.run_folder import RunFolder
from perception.io.object_map import write_object_map
from perception.io.scan_folder import write_scan

BAD_USAGE = {
    "no command": ([], "Expected one of {pack, sort,"),
    "unknown command": (["pakc"], "Unrecognized options: pakc"),
    "misspelt option": (["pack", "--sed", "3"], "did you mean --seed?"),
    "no number": (["pack", "--seed", "x"], "--seed takes a whole number, not 'x'"),
    "no optional number": (["scan", "--gap", "0,1"], "--gap takes a number, not '0,1'"),
    "no such choice": (["sort", "--shapes", "perfect"], "invalid choice 'perfect'"),
    "no network": (["train"], "{shape,detector,pose,axis,yaw,acceptance,verifier}"),
    "nothing to evaluate": (["evaluate", "everything"], "invalid choice 'everything'"),
    "no scan": (["reconstruct"], "Scan folder"),
}


@pytest.mark.parametrize("arguments, message", BAD_USAGE.values(), ids=BAD_USAGE)
def test_bad_usage_is_one_line_and_exit_code_2(arguments, message, capsys):
    assert run(arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    assert err.startswith("nodeslam: ") and message in err and "--help" in err


def test_options_without_effect_are_refused(capsys):
    assert run(["evaluate", "slam", "--episodes", "3"]) == 2
    assert capsys.readouterr().err == "nodeslam: --episodes has no effect on `evaluate slam`: omit it\n"


def test_cuda_is_refused_where_there_is_none_also_by_commands_without_networks(capsys, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert run(["convert", "recording", "--device", "cuda"]) == 2
    assert capsys.readouterr().err.startswith("nodeslam: --device cuda: this machine has no usable CUDA")


def test_the_version_is_printed(capsys):
    assert run(["--version"]) == 0
    assert re.fullmatch(r"nodeslam \d+\.\d+\.\d+\S*\n", capsys.readouterr().out)


def test_bad_usage_is_told_in_ascii_too():
    command = [sys.executable, "-m", "app", "export", "somewhere", "--format", "foo"]
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    assert ended.returncode == 2
    assert ended.stderr.startswith("nodeslam: invalid choice 'foo'") and ended.stderr.count("\n") == 1


def test_help_in_one_column_takes_no_minutes():
    environment = os.environ | {"COLUMNS": "1"}
    command = [sys.executable, "-m", "app", "pack", "--help"]
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=30)
    assert ended.returncode == 0 and "--objects" in ended.stdout


@pytest.mark.parametrize(
    "threads, valid", [("2", True), ("4,2", True), ("many", False), ("0", False), ("", False)]
)
def test_openmp_is_told_a_number_of_threads(monkeypatch, threads, valid):
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    if valid:
        cli.check(DoctorOptions())
    else:
        with pytest.raises(UsageError, match="is no number of threads: unset it"):
            cli.check(DoctorOptions())


def test_the_build_time_is_a_number(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    cli.check(DoctorOptions())
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    with pytest.raises(UsageError, match="SOURCE_DATE_EPOCH=yesterday is no time in seconds: unset it"):
        cli.check(DoctorOptions())


def test_the_working_directory_exists(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    tmp_path.rmdir()
    with pytest.raises(UsageError, match="the working directory was removed: change to another one"):
        cli.check(DoctorOptions())


BAD_INPUT = {
    "objects: class": (["pack", "--objects", "spoon=2"], "'spoon' is none of mug, bowl, bottle, can"),
    "objects: count": (["sort", "--objects", "mug=two"], "'mug=two' has no count"),
    "objects: thousand": (
        ["pack", "--objects", "1000"],
        "--objects 1000 asks for 1000 objects; the table holds",
    ),
    "objects: by class": (["pack", "--objects", "mug=30,can=5"], "mug=30,can=5 asks for 35 objects"),
    "objects: 5000 digits": (["pack", "--objects", "9" * 5000], "asks for 10**9 or more objects"),
    "seed: negative": (["scan", "--seed=-1"], "--seed -1 must be in 0..2**64 - 1"),
    "seed: huge": (["doctor", "--seed", str(2**64)], "must be in 0..2**64 - 1"),
    "seconds: zero": (["ar", "run", "--seconds", "0"], "--seconds 0 must be more than 0 and at most 600"),
    "seconds: NaN": (["ar", "run", "--seconds", "nan"], "--seconds nan must be more than 0"),
    "seconds: long": (["ar", "run", "--seconds", "601"], "--seconds 601 must be more than 0 and at most 600"),
    "port: negative": (["view", "--port=-1"], "--port -1 must be in 0..65535"),
    "port: large": (["view", "--port", "65536"], "--port 65536 must be in 0..65535"),
    "out: empty": (["scan", "--out", ""], "argument '' is empty: omit it"),
    "out: empty after =": (["scan", "--out="], "argument '--out=' is empty: omit it"),
    "long name": (["reconstruct", "x" * 300], "File name too long"),
    "objects: none": (["pack", "--objects", "0"], "asks for 0 objects"),
    "objects: too many": (["pack", "--objects", "mug=999999999"], "the table holds 1 to about 12"),
    "box: words": (["pack", "--box", "large"], "three lengths in metres"),
    "box: two numbers": (["pack", "--box", "0.3,0.3"], "three lengths in metres"),
    "box: huge": (["pack", "--box", "3,0.3,0.08"], "--box L = 3 m must be in"),
    "box: NaN": (["pack", "--box", "nan,0.3,0.08"], "--box L = nan m must be in"),
    "scan: nowhere": (["reconstruct", "/nowhere"], "/nowhere is not a folder"),
    "no meshes": (["pack", "--object-meshes", "/nowhere"], "--object-meshes /nowhere is no folder"),
    "no robot": (["scan", "--robot", "/nowhere.toml"], "--robot /nowhere.toml is no robot file"),
    "epochs": (["train", "yaw", "--epochs", "0"], "--epochs 0 must be in 1..1000000"),
    "tolerance: NaN": (
        ["bench", "--against", "report.json", "--tolerance", "nan"],
        "--tolerance nan must be at least 0 and below 1",
    ),
    "growth: workers": (
        ["bench", "--growth", "--growth-workers", "1", "0"],
        "different numbers from 1 to 256",
    ),
    "workers": (["evaluate", "tasks", "--workers", "0"], "--workers 0 must be in 1..256"),
    "episodes": (
        ["evaluate", "tasks", "--episodes", "999999999999"],
        "--episodes 999999999999 must be in 1..1000000",
    ),
    "resume nowhere": (["evaluate", "tasks", "--resume"], "--resume needs --out"),
}


@pytest.mark.parametrize("arguments, message", BAD_INPUT.values(), ids=BAD_INPUT)
def test_bad_input_is_one_line_and_exit_code_2(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run([*arguments, "--quiet"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and message in err


def test_out_that_is_no_run_folder_is_left_alone(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert run(["pack", "--out", str(tmp_path)]) == 2
    assert "is not empty and no run folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def pretend(monkeypatch, behaviour):
    monkeypatch.setattr(cli, "_handler", lambda command: behaviour)


@pytest.mark.parametrize("success, code", [(True, 0), (False, 1)])
def test_exit_code_says_whether_the_task_was_done(monkeypatch, success, code):
    pretend(monkeypatch, lambda options, screen: Report("pack", 0, success=success))
    assert run(["pack"]) == code


def test_json_is_alone_on_standard_output(monkeypatch, capfd):
    def noisy(options, screen):
        print("a library says hello")  # noqa: T201
        screen.show("a table")
        subprocess.run(["echo", "and so does a native one"], check=True)
        return Report("sort", 7, objects=[ObjectReport(1, "mug", error_tilt=float("nan"))])

    pretend(monkeypatch, noisy)
    assert run(["sort", "--json", "--seed", "7"]) == 1
    out, err = capfd.readouterr()
    report = json.loads(out)
    assert (report["command"], report["seed"], report["success"]) == ("sort", 7, False)
    assert report["objects"][0]["error_tilt"] is None  # JSON has no NaN
    assert "a library says hello" in err and "native" in err and "a table" not in err


def test_a_reader_that_ends_early_changes_no_exit_code(monkeypatch):
    pretend(monkeypatch, lambda options, screen: Report("sort", 7, success=True))
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w", closefd=False) as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        monkeypatch.setattr(cli, "_stdout_reserved", lambda reserve: contextlib.nullcontext())
        assert run(["sort", "--json"]) == 0
        os.dup2(os.open(os.devnull, os.O_WRONLY), writer)  # for what is left in the buffer
    os.close(writer)


def test_interruption_is_130(monkeypatch, capsys):
    def interrupted(options, screen):
        raise KeyboardInterrupt

    pretend(monkeypatch, interrupted)
    assert run(["scan"]) == 130
    assert capsys.readouterr().err == "nodeslam: interrupted; finished results are kept\n"


def test_termination_is_143(monkeypatch, capsys):
    def interrupted(options, screen):
        raise KeyboardInterrupt

    pretend(monkeypatch, interrupted)
    monkeypatch.setattr("app.interrupts._received", signal.SIGTERM)
    assert run(["scan"]) == 143
    assert capsys.readouterr().err == "nodeslam: interrupted; finished results are kept\n"


def failing_with(error, monkeypatch, folder=None):
    def fail(options, screen):
        if folder is not None:
            RunFolder.create(options, "pack").write_json("objects.json", [])
        raise error

    pretend(monkeypatch, fail)


def test_a_full_disk_is_one_line_and_a_log(monkeypatch, capsys, tmp_path):
    failing_with(OSError(errno.ENOSPC, "No space left on device", "x.png"), monkeypatch, tmp_path)
    assert run(["pack", "--out", str(tmp_path / "run")]) == 2
    log = tmp_path / "run" / "error.log"
    assert capsys.readouterr().err == (
        "nodeslam: x.png: No space left on device; free some space or give --out on another disk; "
        f"traceback in {log}\n"
    )
    assert "in fail" in log.read_text()


def test_an_unexpected_error_is_one_line_and_a_log(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    failing_with(ZeroDivisionError("division by zero"), monkeypatch)
    assert run(["doctor"]) == 1
    err = capsys.readouterr().err
    assert err.startswith(
        "nodeslam: doctor failed unexpectedly: ZeroDivisionError: division by zero; traceback"
    )
    assert err.count("\n") == 1 and "in fail" in next(tmp_path.glob("nodeslam-*.log")).read_text()


def test_debug_shows_the_traceback(monkeypatch, capsys):
    failing_with(UsageError("wrong"), monkeypatch)
    assert run(["pack", "--debug"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("Traceback") and "in fail" in err and err.endswith("nodeslam: wrong\n")


def test_an_interruption_names_the_replaced_run(monkeypatch, capsys, tmp_path):
    with RunFolder.create(DoctorOptions(out=tmp_path / "run"), "doctor"):
        pass
    failing_with(KeyboardInterrupt(), monkeypatch, tmp_path)
    assert run(["pack", "--out", str(tmp_path / "run")]) == 130
    assert capsys.readouterr().err == (
        f"nodeslam: interrupted; finished results are kept; the run before is in {tmp_path}/run/.previous\n"
    )


@pytest.mark.parametrize("backend, code", [("foo", 2), ("EGL", 0), ("", 0), ("off", 0)])
def test_an_unknown_opengl_backend_is_refused(monkeypatch, capsys, backend, code):
    pretend(monkeypatch, lambda options, screen: Report("scan", 0, success=True))
    monkeypatch.setenv("MUJOCO_GL", backend)
    assert run(["scan"]) == code
    err = capsys.readouterr().err
    assert err == (
        "nodeslam: MUJOCO_GL=foo is no OpenGL backend: unset it, or set it to egl or osmesa\n" * (code // 2)
    )


def test_an_unknown_opengl_platform_is_refused(monkeypatch, capsys):
    monkeypatch.setenv("PYOPENGL_PLATFORM", "foo")
    assert run(["scan"]) == 2
    assert capsys.readouterr().err == (
        "nodeslam: PYOPENGL_PLATFORM=foo is no platform of PyOpenGL: unset it\n"
    )


def test_too_little_address_space_is_refused_before_libraries_are_loaded(monkeypatch, capsys):
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (200 * 2**20, resource.RLIM_INFINITY))
    assert run(["scan"]) == 2
    assert capsys.readouterr().err == (
        "nodeslam: 200 MB of address space (ulimit -v) are too little: allow 1024 MB or more\n"
    )


@pytest.mark.parametrize("stack, code", [(2**18, 2), (2**19, 0), (resource.RLIM_INFINITY, 0)])
def test_a_stack_with_which_libraries_crash_is_refused(monkeypatch, stack, code):
    limits = {resource.RLIMIT_STACK: stack}
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (limits.get(kind, resource.RLIM_INFINITY),) * 2)
    if code == 0:
        cli.check(DoctorOptions())
    else:
        with pytest.raises(UsageError, match=r"256 kB of stack \(ulimit -s\) are too little: allow 512 kB"):
            cli.check(DoctorOptions())


def test_the_gpu_of_the_renderer_is_a_number(monkeypatch):
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", "0")
    cli.check(DoctorOptions())
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", "first")
    with pytest.raises(UsageError, match="MUJOCO_EGL_DEVICE_ID=first is no number of a GPU: unset it"):
        cli.check(DoctorOptions())


def test_paths_that_the_shell_leaves_with_a_tilde_are_below_the_home_directory(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert parse(["pack", "--out=~/runs/one"]).out == tmp_path / "runs/one"
    assert parse(["reconstruct", "~"]).scan == tmp_path
    assert parse(["reconstruct", "~scan"]).scan == Path("~scan")  # of no user's home
    assert parse(["reconstruct", "scan~/one"]).scan == Path("scan~/one")


@pytest.fixture
def finished(tmp_path, overhead_frame, can_at):
    """Return the folder of a run with a scan, an object map and meshes of a person."""
    path = tmp_path / "run"
    with RunFolder.create(DoctorOptions(out=path), "pack") as folder:
        write_scan(folder.scan, [overhead_frame] * 2)
        write_object_map(path, [can_at()])
        (path / "meshes" / "can").mkdir(parents=True)
        (path / "meshes" / "can" / "c.ply").write_bytes((path / "objects" / "0_can.ply").read_bytes())
    return path


OWN_INPUTS = {
    "ar": ["ar", "{run}"],
    "slam": ["slam", "{run}/scan"],
    "reconstruct": ["reconstruct", "{run}/scan"],
    "export": ["export", "{run}/../run/."],
}


@pytest.mark.parametrize("arguments", OWN_INPUTS.values(), ids=OWN_INPUTS)
def test_no_command_overwrites_its_own_input(finished, capsys, arguments):
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    command = [argument.format(run=finished) for argument in arguments]
    assert run([*command, "--out", str(finished), "--quiet"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and f"--out {finished} " in err and "the input" in err
    assert {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    "options",
    [
        lambda path: BenchOptions(scan=path / "scan", out=path),
        lambda path: ScanOptions(object_meshes=path / "meshes", out=path),
    ],
    ids=["bench", "scan"],
)
def test_scans_and_meshes_in_a_run_are_inputs(finished, options):
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    with pytest.raises(UsageError, match="contains the input"):
        RunFolder.create(options(finished), "bench")
    assert {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()} == before


def test_errors_of_many_lines_become_one(monkeypatch, capsys):
    def failing(options, screen):
        raise UsageError("first\n   second")

    pretend(monkeypatch, failing)
    assert run(["pack"]) == 2
    assert capsys.readouterr().err == "nodeslam: first second\n"


def test_help_lists_the_commands_without_loading_anything_heavy():
    code = (
        "import sys; from app.cli import run; code = run(['--help']);"
        "heavy = {'torch', 'mujoco', 'numpy', 'trimesh', 'warp'} & set(sys.modules);"
        "print('HEAVY', sorted(heavy)); sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    for command in ("pack", "sort", "scan", "reconstruct", "train", "evaluate", "doctor"):
        assert f"• {command} " in done.stdout
    assert "HEAVY []" in done.stdout
