"""``nodeslam doctor --robot``: report, exit code, and all problems of a file one a line."""

import numpy as np
import pytest

from app.cli import run as run_cli
from app.robots import doctor
from app.robots.checks import RobotFinding
from app.robots.examination import Examination
from manipulation.workspace import ReachFit, Workspace


@pytest.fixture
def examined(monkeypatch):
    found = [
        RobotFinding("good", "hand", "opens"),
        RobotFinding("warning", "camera", "half hidden", "move it"),
    ]
    monkeypatch.setattr(
        doctor,
        "examine_robot",
        lambda robot: Examination(tuple(found), np.array([0.3, 0.6]), ReachFit(Workspace(), 1.0)),
    )
    monkeypatch.setattr(doctor, "write_picture", lambda path, robot, examination: path.write_bytes(b""))
    return found


def test_findings_are_shown_with_remedies(examined, tmp_path, capsys):
    assert run_cli(["doctor", "--robot", "panda", "--out", str(tmp_path / "run")]) == 0
    shown = capsys.readouterr().out
    assert "half hidden" in shown and "move it" in shown and "0 faults, 1 warnings" in shown
    assert (tmp_path / "run" / "robot.png").exists() and (tmp_path / "run" / "report.json").exists()


def test_a_fault_is_exit_code_1(examined, tmp_path):
    examined.append(RobotFinding("fault", "home", "link5 touches table", "change it"))
    assert run_cli(["doctor", "--robot", "panda", "--out", str(tmp_path / "run"), "--quiet"]) == 1


def test_an_unusable_file_is_exit_code_2_with_all_problems(tmp_path, capsys):
    path = tmp_path / "robot.toml"
    path.write_text('mjcf = "arm.xml"\n[arm]\njoints = ["a"]\nspeed = 1\n[gripper]\njoints = []\n')
    assert run_cli(["doctor", "--robot", str(path), "--out", str(tmp_path / "run")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[0].startswith("nodeslam: ") and all(line.startswith("  ") for line in lines[1:])
    assert len(lines) == 7 and all("robot.toml" in line for line in lines)
    assert "arm.xml: no such MJCF file" in lines[-1]


def test_an_mjcf_is_drafted_first(examined, tmp_path, capsys):
    (tmp_path / "arm.xml").write_text("<mujoco/>")
    arguments = ["doctor", "--robot", str(tmp_path / "arm.xml"), "--out", str(tmp_path / "run")]
    assert run_cli(arguments) == 2
    assert "the model has no joints" in capsys.readouterr().err
