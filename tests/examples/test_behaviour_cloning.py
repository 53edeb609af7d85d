"""The example of behaviour cloning: its training data, and a run on a small data set."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import nodeslam

ROOT = Path(nodeslam.__file__).parent
EXAMPLE = ROOT / "examples" / "behaviour_cloning.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("behaviour_cloning", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["behaviour_cloning"] = module  # dataclasses look for it
    spec.loader.exec_module(module)
    yield module
    del sys.modules["behaviour_cloning"]


def test_frames_advance_or_have_a_working_gripper(example):
    goal = np.zeros((60, 3))
    goal[:21, 0], goal[21:, 0] = 0.1 * example.STEP * np.arange(21), 2 * example.STEP  # slowly, then rests
    goal[50:, 1] = 2 * example.STEP  # a jump
    kept = example.advancing(goal * (1 + 1e-9), np.arange(60) >= 30)
    assert kept.tolist() == [0, 10, 20, *range(30, 30 + example.GRIPPING), 50]


def test_displaced_tools_are_led_back_to_the_path_and_carry_what_they_hold(example):
    n = 40
    path = np.linspace([0.3, -0.2, 0.3], [0.5, 0.1, 0.3], n)
    yaw = np.linspace(0.1, 2.9, n)
    held = np.arange(n) >= 20
    widths = np.repeat(np.where(held, 0.05, 0.08)[:, None], 3, axis=1)
    thing = np.column_stack([path - np.array([0, 0, 0.1]), np.full(n, 0.12), np.full(n, 0.03)])
    episode = example.Episode(path, yaw, widths, thing, path, yaw, held)
    inputs, targets = example.samples([episode], np.random.default_rng(0))
    ahead = np.arange(n)[:, None] + np.arange(example.AHEAD)
    later = np.minimum(ahead, n - 1)
    straight_on = path[0] + ahead[..., None] * (path[1] - path[0])  # beyond the end, too
    np.testing.assert_allclose(inputs[:, None, :3] + targets[..., :3], straight_on)
    assert np.linalg.norm(inputs[:20, :3] - path[:20], axis=1).mean() > 0.01
    np.testing.assert_allclose(
        np.arctan2(targets[..., 4], targets[..., 3]) % (2 * np.pi), 2 * yaw[later] % (2 * np.pi)
    )
    np.testing.assert_array_equal(targets[..., 5], held[later])
    in_hand = inputs[:, 3:6] - (path - thing[:, :3])
    np.testing.assert_allclose(in_hand[held], 0, atol=1e-12)
    assert np.abs(in_hand[~held]).max() > 0.01


def test_a_pose_that_points_down_is_rigid_with_its_yaw(example):
    T = example.pointing_down(np.array([0.4, 0.1, 0.2]), 0.7)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert T[2, 2] == -1 and np.arctan2(T[1, 1], T[0, 1]) == pytest.approx(0.7)
    np.testing.assert_array_equal(T[:3, 3], [0.4, 0.1, 0.2])


def test_the_example_runs_beside_the_expert(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MUJOCO_GL": "egl"}
    collect = (
        "-m app collect --objects can=1 --shapes oracle --episodes 1 --no-images --seed 997000 --out set"
    )
    for arguments in (collect.split(), [EXAMPLE, "set", "--epochs", "2", "--episodes", "1"]):
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stderr
    assert re.search(r"^1 episodes, loss \d\.\d{3} to \d\.\d{3}, \d+ s on one core$", done.stdout, re.M)
    last = done.stdout.splitlines()[-1]
    assert re.fullmatch(r"success: policy (0|100)% \([01] of 1\), expert 100% \(1 of 1\)", last), done.stdout
