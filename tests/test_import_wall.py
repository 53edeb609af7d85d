"""The walls between the packages: who may import whom, in the source and when it runs."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("app", "perception", "manipulation", "sim_assets")
READERS_OF_TRUTH = {"app/task/scoring.py", "app/training/crop_dataset.py"}


def modules():
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def imported(path):
    """Every module name an import statement mentions, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_import_contracts_hold():
    linter = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([linter, "--no-cache"], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


def test_only_scoring_and_labels_read_the_truth():
    readers = {
        str(path.relative_to(ROOT))
        for path in modules()
        if any(name.startswith("sim_assets.cell.ground_truth") for name in imported(path))
    }
    assert readers <= READERS_OF_TRUTH


def test_app_does_not_reach_into_the_simulator():
    """The physics state is private to sim_assets: not even scoring takes it from there."""
    for path in (ROOT / "app").glob("*.py"):
        assert not re.search(r"\._(data|model)\b", path.read_text(encoding="utf-8")), path.name


@pytest.mark.parametrize("package, forbidden", [("perception", "mujoco"), ("perception", "mink")])
def test_no_module_of_the_package_mentions(package, forbidden):
    wrong = [
        path.name
        for path in modules()
        if path.is_relative_to(ROOT / package) and forbidden in {n.split(".")[0] for n in imported(path)}
    ]
    assert not wrong


BLOCK = """
import importlib, pkgutil, sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"mujoco", "mink", "ruckig", "daqp", "coacd", "open3d", "sim_assets"}:
            raise ModuleNotFoundError(f"{name} is blocked", name=name)
sys.meta_path.insert(0, Block())
"""


def run_blocked(code, *arguments):
    """Run Python in which the simulator cannot be imported."""
    return subprocess.run(
        [sys.executable, "-c", BLOCK + code, *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_perception_imports_whole_without_a_simulator():
    code = """
import perception
for module in pkgutil.walk_packages(perception.__path__, "perception."):
    importlib.import_module(module.name)
print("all imported")
"""
    done = run_blocked(code)
    assert done.returncode == 0 and "all imported" in done.stdout, done.stderr


def test_simulated_commands_say_what_to_install(tmp_path):
    done = run_blocked(
        "from app.cli import run; sys.exit(run(['pack', '--quiet', '--out', sys.argv[1]]))", tmp_path / "run"
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "pip install 'nodeslam[sim]'" in done.stderr
