"""``nodeslam robot init``: writes a file once, refuses what it cannot read."""

import pytest

from app.cli import run as run_cli
from app.robots import command
from app.robots.draft import Draft


@pytest.fixture
def drafted(monkeypatch):
    calls = []

    def draft_robot(*arguments):
        calls.append(arguments)
        return Draft("mjcf = 'arm.xml'\n", ("the tool frame is measured",))

    monkeypatch.setattr(command, "draft_robot", draft_robot)
    return calls


def test_the_file_is_written_and_assumptions_are_shown(drafted, tmp_path, capsys):
    (tmp_path / "arm.xml").write_text("<mujoco/>")
    out = tmp_path / "cells" / "mine.toml"
    assert run_cli(["robot", "init", str(tmp_path / "arm.xml"), "--out", str(out)]) == 0
    assert out.read_text() == "mjcf = 'arm.xml'\n"
    assert "the tool frame is measured" in capsys.readouterr().out
    assert drafted[0][1] == out.parent


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.xml"], "ARM none.xml is no file: give an MJCF model"),
        (["arm.xml", "--hand", "arm.xml"], "--hand needs --mount SITE"),
        (["arm.xml", "--out", "robot.toml"], "robot.toml exists: remove it"),
        (["bad.xml"], "bad.xml cannot be read as MJCF"),
    ],
)
def test_bad_usage(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text("<mujoco/>")
    (tmp_path / "bad.xml").write_text("<mujoco>")
    if "--out" in arguments:
        (tmp_path / "robot.toml").write_text("")
    assert run_cli(["robot", "init", *arguments]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and message in lines[0]
