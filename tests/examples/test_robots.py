"""Robot files of arms whose models come from elsewhere: drafted by ``robot init``, and loaded where they are.

The models are found through environment variables, as in the files; without them the tests are skipped.
"""

import os
import re
import tomllib
from pathlib import Path

import pytest

import nodeslam
from app.cli import run as run_cli
from app.robots.draft import draft_robot
from app.task.cell import load_arm

FOLDER = Path(nodeslam.__file__).parent / "examples" / "robots"
FILES = sorted(FOLDER.glob("*.toml"))
EDITED_MAX = 3  # lines of a file that `robot init` wrote


def model(path):
    """Return the entries of a file and the paths of its models; skip the test where one is absent."""
    entries = tomllib.loads(path.read_text())
    found = [entries["mjcf"], *([entries["hand"]["mjcf"]] if "hand" in entries else [])]
    files = [Path(os.path.expandvars(name)) for name in found]
    if not all(file.is_file() for file in files):
        pytest.skip(f"set {', '.join(sorted(variables(path)))} to the folder of the models")
    return entries, files


def variables(path):
    return set(re.findall(r"\$\{(\w+)\}", path.read_text()))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_absent_models_are_one_line_with_the_variable_to_set(path, monkeypatch, capsys):
    for name in variables(path):
        monkeypatch.delenv(name, raising=False)
    assert variables(path) and run_cli(["pack", "--robot", str(path)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert any(f"set the environment variable {name}" in line for name in variables(path) for line in lines)
    assert lines[0].startswith("nodeslam: ") and all(line.startswith("  ") for line in lines[1:])


@pytest.mark.slow
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_arms_load_and_reach_a_cell(path):
    model(path)
    arm = load_arm(str(path)).description
    assert 0.04 < arm.max_width < 0.12 and len(arm.joint_names) in (5, 6, 7)


@pytest.mark.slow
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_files_are_drafts_with_few_edited_lines(path):
    entries, (arm, *hand) = model(path)
    mount = entries.get("hand", {}).get("mount", "")
    drafted = draft_robot(arm, path.parent, *hand[:1], mount=mount, root=entries["arm"].get("body", "")).text
    edited = [
        line for line in path.read_text().splitlines() if line not in drafted.splitlines() and line[:1] != "#"
    ]
    assert len(edited) <= EDITED_MAX, edited
