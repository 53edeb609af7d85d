"""Tests mirror the sources: ``tests/package/folder/test_module.py`` tests ``package/folder/module.py``."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("app", "perception", "manipulation", "sim_assets")

# Test files of more than one module.
SEVERAL_MODULES = {
    "test_conftest.py",  # the check of array shapes, with modules as examples
    "test_end_to_end.py",  # whole commands
    "test_faults.py",  # full disks and signals, over many commands
    "test_import_wall.py",  # walls between all packages
    "test_layout.py",
    "test_wrong_robots.py",  # robot files through the command line
    "app/viewer/test_cost.py",  # load of the whole viewer on a run
    "app/viewer/test_live_in_browser.py",  # the whole viewer in a browser
    "app/viewer/test_page_in_browser.py",
    "app/viewer/test_replay_in_browser.py",
    "perception/test_cuda_source.py",  # the kernels of all packages, through the CUDA compiler
    "sim_assets/cell/test_grasping.py",  # physics of grasps: arm, objects and world together
    "sim_assets/robots/test_sixaxis.py",  # a robot file with its model
}


def has_code(path):
    """Whether a module defines a function or a method: constants and plain dataclasses need no test."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return any(isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) for node in ast.walk(tree))


def modules():
    found = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return {path.relative_to(ROOT) for path in found if path.name != "__init__.py"}


def files_of_tests():
    found = {path.relative_to(ROOT / "tests") for path in (ROOT / "tests").rglob("test_*.py")}
    return {path for path in found if path.parts[0] not in ("docs", "examples")}


def test_every_module_with_code_has_a_test_file():
    expected = {path for path in modules() if has_code(ROOT / path)}
    missing = {path.with_name(f"test_{path.name}") for path in expected} - files_of_tests()
    assert not missing, f"{len(missing)} modules without a test: " + ", ".join(sorted(map(str, missing)))


def test_every_test_file_belongs_to_a_module():
    mirrored = {path.with_name(f"test_{path.name}") for path in modules()}
    top = {Path(f"test_{path.name}") for path in ROOT.glob("*.py")}
    packages = {
        path.relative_to(ROOT).parent.with_name(f"test_{path.parent.name}.py")
        for package in PACKAGES
        for path in (ROOT / package).rglob("__init__.py")
    }
    stray = files_of_tests() - mirrored - top - packages - {Path(name) for name in SEVERAL_MODULES}
    assert not stray, "test files without a module: " + ", ".join(sorted(map(str, stray)))


def test_exceptions_exist():
    """A renamed or removed file leaves no entry behind."""
    assert {Path(name) for name in SEVERAL_MODULES} <= files_of_tests()
