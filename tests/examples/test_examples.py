"""Every example runs as a user runs it: in its own process, from another folder, without arguments."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import nodeslam

ROOT = Path(nodeslam.__file__).parent
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
ALLOWED = {"nodeslam", "sample_data", "numpy", "PIL", "trimesh"} | set(sys.stdlib_module_names)

# What each must print, as regular expressions: all objects found, mapped, grasped, packed, placed.
EXPECTED = {
    "01_reconstruct_image": [r"^4 objects", r"^(mug|bowl|bottle|can)_\d: .* standard deviation \d+\.\d mm$"],
    "02_reconstruct_scan": [r"^mug_\d: .* seen in 3 views, converged$", r"^object map with meshes in "],
    "03_grasps_for_your_planner": [rf"^{kind}_\d: [1-9]\d* grasps" for kind in nodeslam.CATEGORIES],
    "04_slam_sequence": [r"^frame 7: tracked, 4 objects in view$", r"^object map and trajectory in "],
    "05_your_robot": [r"^can_0: packed, 1 attempts$"],
    "06_your_shapes": [r"^true: bowl cone, height 0\.0550 m$", r"^found: bowl_0, height 0\.05\d\d m"],
    "07_custom_task": [r"^bottle_\d: placed$", r"^can_\d: placed$"],
    "08_network_robot": [r"^can_0: packed$", r"^stopped: the example is over$"],
}


def test_examples_are_numbered_without_gaps_and_all_tested():
    assert [path.stem for path in EXAMPLES] == sorted(EXPECTED)
    assert [int(path.stem[:2]) for path in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))


@pytest.mark.parametrize(
    "path", [*EXAMPLES, ROOT / "examples" / "sample_data.py"], ids=lambda path: path.stem
)
def test_examples_need_the_public_interface_alone(path):
    imported = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            imported |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add((node.module or "").split(".")[0])
    assert imported <= ALLOWED


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_run(path, tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MUJOCO_GL": "egl", "TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, path], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    for pattern in EXPECTED[path.stem]:
        assert re.search(pattern, done.stdout, re.M), f"{pattern} is not in\n{done.stdout}"
