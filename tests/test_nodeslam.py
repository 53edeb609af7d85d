"""The public interface: complete, light to import, typed, and safe beside modules of the same names."""

import ast
import importlib
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pytest

import nodeslam

ROOT = Path(nodeslam.__file__).parent
FRONT_DOORS = ("nodeslam", "perception", "manipulation")
HEAVY = ("numpy", "scipy", "torch", "warp", "cv2", "trimesh", "mujoco", "rich")


def python(*arguments, cwd, **environment):
    """Run a Python of this environment in ``cwd`` with the project on its path."""
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=cwd,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), "MUJOCO_GL": "egl", **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )


def typed_names(module):
    """The names that a front door imports for type checkers."""
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    (block,) = (n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING")
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.asname: (node.module, alias.name) for node in imports for alias in node.names}


@pytest.mark.parametrize("name", FRONT_DOORS)
def test_every_public_name_is_what_type_checkers_see(name):
    module = importlib.import_module(name)
    typed = typed_names(module)
    assert set(typed) == set(module.__all__) - {"__version__"}
    assert len(set(module.__all__)) == len(module.__all__)
    for public, (source, original) in typed.items():
        assert public == original
        assert getattr(module, public) is getattr(importlib.import_module(source), original)
    assert sorted(dir(module)) == sorted(module.__all__)


@pytest.mark.parametrize("name", FRONT_DOORS)
def test_unknown_names_are_attribute_errors(name):
    with pytest.raises(AttributeError, match=f"^module '{name}' has no attribute 'nonsense'$"):
        getattr(importlib.import_module(name), "nonsense")  # noqa: B009


def test_version_is_that_of_the_distribution():
    assert nodeslam.__version__ == version("nodeslam")


@pytest.mark.parametrize("name", FRONT_DOORS)
def test_import_loads_nothing_heavy(name, tmp_path):
    code = f"import sys; before = set(sys.modules); import {name}; print(*(set(sys.modules) - before))"
    done = python("-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    loaded = {module.split(".")[0] for module in done.stdout.split()}
    assert name in loaded and not loaded & set(HEAVY)


def test_every_package_ships_its_types():
    for package in ("app", "perception", "manipulation", "sim_assets"):
        assert (ROOT / package / "py.typed").is_file()


@pytest.mark.parametrize("file", ["perception.py", "manipulation.py", "sim_assets/__init__.py"])
def test_a_foreign_package_is_refused_by_name(file, tmp_path):
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_text("")
    (tmp_path / "script.py").write_text("import nodeslam")
    done = python("script.py", cwd=tmp_path)
    package = Path(file).parts[0].removesuffix(".py")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        f"ImportError: nodeslam's package '{package}' is hidden by {tmp_path / file}: "
        "rename that file, or take its folder off sys.path"
    )


def test_a_foreign_app_does_not_matter_to_the_library(tmp_path):
    (tmp_path / "app.py").write_text("raise RuntimeError('foreign')")
    (tmp_path / "script.py").write_text("import nodeslam; print(nodeslam.Box().size)")
    done = python("script.py", cwd=tmp_path)
    assert done.returncode == 0 and done.stdout == "(0.34, 0.3, 0.08)\n", done.stderr


def test_import_after_gymnasium_registers_the_environments_and_loads_nothing_heavy(tmp_path):
    code = (
        "import sys; import gymnasium; before = set(sys.modules); import nodeslam; "
        "print(gymnasium.spec('nodeslam/Sort-v0').entry_point, *(set(sys.modules) - before))"
    )
    done = python("-c", code, cwd=tmp_path)
    assert done.returncode == 0 and not done.stderr, done.stderr
    entry_point, *loaded = done.stdout.split()
    assert entry_point == "app.environments.environment:SortEnv"
    assert "nodeslam" in loaded and not {name.split(".")[0] for name in loaded} & set(HEAVY)


def test_gymnasium_imports_the_package_that_the_name_of_an_environment_begins_with(tmp_path):
    code = "import gymnasium; print(gymnasium.make('nodeslam:nodeslam/Pack-v0').unwrapped.task)"
    done = python("-c", code, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "pack\n", "")


@pytest.mark.parametrize(
    "before", ["", "import sys; sys.modules['gymnasium'] = None; ", "import gymnasium; "]
)
def test_import_is_silent_without_gymnasium_and_beside_a_foreign_app(before, tmp_path):
    if "import gymnasium" in before:
        (tmp_path / "app.py").write_text("raise RuntimeError('foreign')")
    done = python("-c", f"{before}import nodeslam; print(nodeslam.Box.__name__)", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "Box\n", "")


@pytest.mark.parametrize("hidden", ["app.py", "perception.py"])
def test_python_m_nodeslam_runs_beside_foreign_modules(hidden, tmp_path):
    (tmp_path / hidden).write_text("raise RuntimeError('foreign')")
    done = python("-m", "nodeslam", "--help", cwd=tmp_path)
    assert done.returncode == 0 and done.stdout.startswith("usage: nodeslam"), done.stderr


SCRIPT = """
import multiprocessing
import sys

import nodeslam

def child(queue):
    import app
    queue.put(app.__file__)

if __name__ == "__main__":
    sys.argv = ["nodeslam", "--help"]
    try:
        nodeslam.main()
    except SystemExit as end:
        assert not end.code
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=child, args=(queue,))
    process.start()
    print(queue.get(timeout=60))
    process.join()
"""


def test_the_console_script_and_its_children_find_the_products_app(tmp_path):
    (tmp_path / "app.py").write_text("raise RuntimeError('foreign')")
    (tmp_path / "console.py").write_text(SCRIPT)
    done = python("console.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == str(ROOT / "app" / "__init__.py")


def test_the_program_in_the_docstring_runs(tmp_path, monkeypatch, capsys):
    docstring = nodeslam.__doc__ or ""
    start, end = docstring.index("    import cv2"), docstring.index("This module is")
    program = "\n".join(line[4:] for line in docstring[start:end].splitlines())
    lines = [line for line in program.splitlines() if line]
    assert len(lines) <= 12
    fovy = float(np.degrees(2 * np.arctan(240 / 600)))
    config = nodeslam.SequenceConfig(
        width=640, height=480, fovy=fovy, objects=2, frames=1, spread=0.13, look_at=0.02
    )
    frame = next(nodeslam.TableSequence(1, config).render()).frame
    cv2.imwrite(str(tmp_path / "rgb.png"), cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))
    cv2.imwrite(str(tmp_path / "depth.png"), np.rint(1000 * frame.depth).astype(np.uint16))
    monkeypatch.chdir(tmp_path)
    found = {}
    exec(compile(program, "docstring", "exec"), found)
    assert {item.category for item in found["scene"].objects} == {"mug", "bowl"}
    assert found["item"].name in capsys.readouterr().out
    assert found["grasps"] == sorted(found["grasps"], key=lambda grasp: -grasp.score)
