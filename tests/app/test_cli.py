"""Exit codes and what stands on which stream."""

import json
import os
import subprocess
import sys

import pytest

from app import cli
from app.cli import run
from app.errors import UsageError
from app.runs.report import ObjectReport, Report

BAD_USAGE = {
    "no command": ([], "Expected one of {pack, sort,"),
    "unknown command": (["pakc"], "Unrecognized options: pakc"),
    "misspelt option": (["pack", "--sed", "3"], "did you mean --seed?"),
    "no number": (["pack", "--seed", "x"], "Error parsing --seed"),
    "no such choice": (["sort", "--shapes", "perfect"], "invalid choice 'perfect'"),
    "no network": (["train"], "{shape,detector,yaw}"),
    "nothing to evaluate": (["evaluate", "everything"], "invalid choice 'everything'"),
    "no scan": (["reconstruct"], "Scan folder"),
}


@pytest.mark.parametrize("arguments, message", BAD_USAGE.values(), ids=BAD_USAGE)
def test_bad_usage_is_one_line_and_exit_code_2(arguments, message, capsys):
    assert run(arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    assert err.startswith("nodeslam: ") and message in err and "--help" in err


def test_bad_usage_is_told_in_ascii_too():
    command = [sys.executable, "-m", "app", "export", "somewhere", "--format", "foo"]
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    assert ended.returncode == 2
    assert ended.stderr.startswith("nodeslam: invalid choice 'foo'") and ended.stderr.count("\n") == 1


BAD_INPUT = {
    "objects: class": (["pack", "--objects", "spoon=2"], "'spoon' is none of mug, bowl, bottle, can"),
    "objects: count": (["sort", "--objects", "mug=two"], "'mug=two' has no count"),
    "objects: none": (["pack", "--objects", "0"], "asks for 0 objects"),
    "objects: too many": (["pack", "--objects", "mug=999999999"], "the table holds 1 to about 10"),
    "box: words": (["pack", "--box", "large"], "three lengths in metres"),
    "box: two numbers": (["pack", "--box", "0.3,0.3"], "three lengths in metres"),
    "box: huge": (["pack", "--box", "3,0.3,0.08"], "--box L = 3 m must be in"),
    "box: NaN": (["pack", "--box", "nan,0.3,0.08"], "--box L = nan m must be in"),
    "scan: nowhere": (["reconstruct", "/nowhere"], "/nowhere is not a folder"),
    "no meshes": (["pack", "--object-meshes", "/nowhere"], "--object-meshes /nowhere is no folder"),
    "no robot": (["scan", "--robot", "/nowhere.toml"], "--robot /nowhere.toml is no robot file"),
    "epochs": (["train", "yaw", "--epochs", "0"], "--epochs 0 must be at least 1"),
    "workers": (["evaluate", "tasks", "--workers", "0"], "--workers 0 must be at least 1"),
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


def test_interruption_is_130(monkeypatch, capsys):
    def interrupted(options, screen):
        raise KeyboardInterrupt

    pretend(monkeypatch, interrupted)
    assert run(["scan"]) == 130
    assert capsys.readouterr().err == "nodeslam: interrupted; finished results are kept\n"


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
