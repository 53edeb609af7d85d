"""Rows of the environments: the arm moves, and MuJoCo alone runs for the same time."""

import os
import time

import numpy as np
import pytest

from app.benchmarks import environments
from app.benchmarks.environments import (
    ACTIONS_PER_SWING,
    MeasuredEnv,
    environment_rows,
    processor_time,
    swing,
)


@pytest.mark.parametrize("control", ["joint", "tcp"])
def test_the_arm_swings_about_its_posture(control):
    env = MeasuredEnv(control=control, objects="can=1")
    env.reset(seed=1)
    start, moved = env.cell.world.joint_positions(), 0.0
    actions = swing(env, control)
    assert actions.shape == (ACTIONS_PER_SWING, *env.action_space.shape)
    for action in actions:
        assert env.action_space.contains(action)
        env.step(action)
        moved = max(moved, np.abs(env.cell.world.joint_positions() - start).max())
    assert 0.08 < moved < 0.5
    assert np.abs(env.cell.world.joint_positions() - start).max() < 0.1  # back, but for the servos' lag
    env.close()


def test_mujoco_alone_runs_as_long_as_the_actions():
    env = MeasuredEnv(objects="can=1")
    env.reset(seed=1)
    begin = env.cell.world.time
    env.step(swing(env, "joint")[0])
    after_step = env.cell.world.time
    env.hold(3)
    assert env.cell.world.time - after_step == pytest.approx(3 * (after_step - begin))
    env.close()


@pytest.mark.slow
def test_rows_of_single_environments_and_of_a_vector_run(monkeypatch):
    monkeypatch.setattr(environments, "IN_PARALLEL", 2)
    monkeypatch.setattr(environments, "STEPS", 3)
    names = []
    for row in environment_rows(seed=1):
        row.job()
        row.reference_job()
        names.append(row.name)
        before = row.processor_time(), time.process_time()
        row.reference_job()
        here = time.process_time() - before[1]  # within the interval of the other
        in_all = row.processor_time() - before[0]
        assert in_all >= here > 0
    assert in_all > 2 * here  # the work of the last row is that of its processes
    assert [name.split(",")[-1].strip() for name in names] == [
        "joint actions",
        "tcp actions",
        "joint actions",
        "tcp actions",
    ]
    assert row.scale == row.reference_scale == pytest.approx(1 / 6)


def test_the_processor_time_of_a_process():
    before = time.process_time()
    assert before <= processor_time(os.getpid()) <= time.process_time()
    assert processor_time(None) == 0
