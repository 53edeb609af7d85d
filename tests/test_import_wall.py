"""Walls between the packages: who imports whom, and that nothing but the scorer reaches ground truth."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("app", "perception", "manipulation", "sim_assets")
READERS_OF_TRUTH = {"app/task/scoring.py", "app/environments/privileged.py"}
# Attributes of other objects that begin with an underscore, with the reason why there is no public one.
PRIVATE_ACCESS = {
    ("app/interrupts.py", "_exit"),  # os._exit, a documented function
    ("app/watchdog.py", "_exit"),
    ("app/training/processes.py", "_exit"),
    ("app/workers.py", "_exit"),
    ("app/slam/run.py", "_source"),  # its own class, in a factory
    ("app/viewer/server.py", "_gui_input_handle_from_uuid"),  # viser offers no hook for incoming messages
    ("app/viewer/messages.py", "_impl"),  # viser's description of a control
    ("perception/detection/huggingface.py", "_model_mapping"),  # transformers' table of detectors
}


def sources(*folders):
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]


def relative(path):
    return path.relative_to(ROOT).as_posix()


def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(path):
    """Every module name that an import statement mentions, also inside functions."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def strings(tree):
    """String constants other than docstrings."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, documented) and node.body and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value


def private_attributes(tree):
    """Names with an underscore that are read from or written to anything but self, cls and super()."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Attribute) or not node.attr.startswith("_") or node.attr.endswith("__"):
            continue
        if not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
            yield node.attr


def patched_modules(tree):
    """Imported names whose attributes are assigned or passed to setattr."""
    names = {
        alias.asname or alias.name.split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for alias in node.names
    }
    for node in ast.walk(tree):
        targets = node.targets if isinstance(node, ast.Assign) else []
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "setattr":
            targets = [ast.Attribute(node.args[0], "")]
        owners = [target.value for target in targets if isinstance(target, ast.Attribute)]
        yield from (owner.id for owner in owners if isinstance(owner, ast.Name) and owner.id in names)


def test_import_contracts_hold():
    linter = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([linter, "--no-cache"], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_source_file_is_checked():
    tracked = subprocess.run(
        ["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    if tracked.returncode != 0:
        pytest.skip("not a git checkout")
    expected = {name for name in tracked.stdout.split() if name.split("/")[0] in PACKAGES}
    assert expected - {relative(path) for path in sources(*PACKAGES)} <= {
        name for name in expected if not (ROOT / name).exists()
    }
    assert len(expected) > 250


def test_only_the_scorer_reads_ground_truth():
    readers = {
        relative(path)
        for path in sources(*PACKAGES)
        if any(name.startswith("sim_assets.cell.ground_truth") for name in imported(path))
    }
    assert readers == READERS_OF_TRUTH


def test_no_private_attribute_of_another_object_is_used():
    used = {
        (relative(path), name)
        for path in sources("app", "perception", "manipulation")
        for name in private_attributes(tree_of(path))
    }
    assert used == PRIVATE_ACCESS


def test_the_physics_state_is_not_accessed_by_name():
    """As in getattr(world, "_data") or attrgetter("_data.qpos")."""
    world = tree_of(ROOT / "sim_assets/cell/world.py")
    private = {
        node.attr
        for node in ast.walk(world)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "self"
        and node.attr.startswith("_")
    }
    assert {"_data", "_model"} <= private
    for path in sources("app", "perception", "manipulation"):
        named = {part for text in strings(tree_of(path)) for part in text.split(".")}
        assert not named & private, relative(path)


def test_files_of_true_states_are_unknown_to_perception_and_planning():
    for path in [
        *sources("perception", "manipulation"),
        *(ROOT / f"app/task/{name}.py" for name in ("pipeline", "stages", "further_rounds")),
    ]:
        names = [text for text in strings(tree_of(path)) if "truth" in text or "scene_gt" in text]
        assert not names, relative(path)


def test_no_module_is_patched():
    allowed = {
        "app/__main__.py": ["sys", "sys"],  # closed standard streams, and standard error, are replaced
        "app/interrupts.py": ["sys"],  # the hook for interrupts that Python cannot deliver
    }
    for path in sources("app", "perception", "manipulation"):
        assert list(patched_modules(tree_of(path))) == allowed.get(relative(path), []), relative(path)


@pytest.mark.parametrize(
    ("code", "found"),
    [("robot._data.qpos", ["_data"]), ("self._data", []), ("super().__init__()", []), ("a.b._c()", ["_c"])],
)
def test_private_attributes_are_recognised(code, found):
    assert list(private_attributes(ast.parse(code))) == found


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("import a\na.b = 1", ["a"]),
        ("from a import b\nsetattr(b, 'c', 1)", ["b"]),
        ("import a.b as d\nd.c = 1", ["d"]),
        ("import a\nb = a\nself.a = 1", []),
    ],
)
def test_patches_are_recognised(code, found):
    assert list(patched_modules(ast.parse(code))) == found


@pytest.mark.parametrize("package, forbidden", [("perception", "mujoco"), ("perception", "mink")])
def test_no_module_of_the_package_mentions(package, forbidden):
    wrong = [
        relative(path) for path in sources(package) if forbidden in {n.split(".")[0] for n in imported(path)}
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


def test_simulated_commands_name_the_missing_extra(tmp_path):
    done = run_blocked(
        "from app.cli import run; sys.exit(run(['pack', '--quiet', '--out', sys.argv[1]]))", tmp_path / "run"
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "pip install '.[sim]'" in done.stderr
