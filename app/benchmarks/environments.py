"""Rows of the speed table: the Gymnasium environment beside MuJoCo stepping the same scene.

The arm swings in both kinds of control, so that the physics, the commands and inverse kinematics have work.
MuJoCo alone repeats the last command for the same simulated time, in the same processes.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AsyncVectorEnv
from jaxtyping import Float

from app.benchmarks.timing import Benchmark
from app.environments.actions import Control
from app.environments.environment import PackEnv

SWING = 0.1  # [rad] of each joint
CIRCLE = 0.01  # [m] of the tool per action
ACTIONS_PER_SWING = 40
IN_PARALLEL = 8  # environments of the vector
STEPS = 20  # of the vector per timed call


class MeasuredEnv(PackEnv):
    """The environment with a method that runs MuJoCo alone."""

    def hold(self, n_actions: int) -> None:
        """Repeat the last command for the time of some actions."""
        for _ in range(n_actions):
            self.cell.control.hold()


def environment_rows(seed: int) -> Iterator[Benchmark]:
    """Yield the rows of one environment with each kind of control, and that of a vector."""
    for control in ("joint", "tcp"):
        yield from _single(control, seed)
    yield from _vector(seed)


def swing(env: PackEnv, control: Control) -> Float[np.ndarray, "k a"]:
    """Return the actions of one period of a motion about the present posture, with the hand open."""
    phase = 2 * np.pi * np.arange(ACTIONS_PER_SWING)[:, None] / ACTIONS_PER_SWING
    width = np.full_like(phase, env.robot.description.max_width)
    if control == "joint":
        moves = env.cell.control.q + SWING * np.sin(phase)
    else:
        moves = np.concatenate(
            [CIRCLE * np.cos(phase), CIRCLE * np.sin(phase), 0 * phase.repeat(4, 1)], axis=1
        )
    return np.concatenate([moves, width], axis=1).astype(np.float32)


def _single(control: Control, seed: int) -> Iterator[Benchmark]:
    env = MeasuredEnv(control=control)
    env.reset(seed=seed)
    actions = cycle(swing(env, control))
    yield Benchmark(
        f"step of the environment, six objects, {control} actions",
        "MuJoCo alone, same scene",
        lambda: env.step(next(actions)),
        partial(env.hold, 1),
    )
    env.close()


def _vector(seed: int) -> Iterator[Benchmark]:
    model = MeasuredEnv()
    model.reset(seed=seed)
    rows = cycle(np.repeat(swing(model, "joint")[:, None], IN_PARALLEL, axis=1))
    model.close()
    envs: Any = AsyncVectorEnv([MeasuredEnv] * IN_PARALLEL, context="spawn")
    try:
        envs.reset(seed=seed)

        def steps() -> None:
            for _ in range(STEPS):
                envs.step(next(rows))

        per_step = 1 / (IN_PARALLEL * STEPS)
        yield Benchmark(
            f"step of one of {IN_PARALLEL} vectorised environments, joint actions",
            f"MuJoCo alone in {IN_PARALLEL} processes, same scenes",
            steps,
            partial(envs.call, "hold", STEPS),
            scale=per_step,
            reference_scale=per_step,
            processor_time=lambda: time.process_time() + sum(_processor_time(p.pid) for p in envs.processes),
        )
    finally:
        envs.close()


def _processor_time(pid: int) -> float:
    """Return the processor time of a process in seconds, from Linux's table of processes."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
