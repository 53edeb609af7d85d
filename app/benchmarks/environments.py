"""Rows of the speed table: the Gymnasium environment beside MuJoCo stepping the same scene.

The arm swings in both kinds of control, so that the physics, the commands and inverse kinematics have work.
MuJoCo alone repeats the last command for the same simulated time, in the same processes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from itertools import cycle

import numpy as np
from jaxtyping import Float

from app.benchmarks.timing import Benchmark
from app.environments.actions import Control
from app.environments.environment import PackEnv
from app.environments.vector import CellVectorEnv

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
    """Yield the rows of one environment and of a vector with each kind of control."""
    for control in ("joint", "tcp"):
        yield from _single(control, seed)
    for control in ("joint", "tcp"):
        yield from _vector(control, seed)


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


def _vector(control: Control, seed: int) -> Iterator[Benchmark]:
    model = MeasuredEnv(control=control)
    model.reset(seed=seed)
    rows = cycle(np.repeat(swing(model, control)[:, None], IN_PARALLEL, axis=1))
    model.close()
    envs = CellVectorEnv(IN_PARALLEL, partial(MeasuredEnv, control=control))
    try:
        envs.reset(seed=seed)

        def steps() -> None:
            for _ in range(STEPS):
                envs.step(next(rows))

        per_step = 1 / (IN_PARALLEL * STEPS)
        yield Benchmark(
            f"step of one of {IN_PARALLEL} vectorised environments, {control} actions",
            "MuJoCo alone in the same processes, same scenes",
            steps,
            partial(envs.call, "hold", STEPS),
            scale=per_step,
            reference_scale=per_step,
            processor_time=lambda: (
                time.process_time() + sum(processor_time(process.pid) for process in envs.processes)
            ),
        )
    finally:
        envs.close()


def processor_time(pid: int | None) -> float:
    """Return the processor time of a process in seconds, from its clock; 0 for none, on Linux only.

    ``/proc`` counts in ticks of 10 ms, of which a call takes too few. The number of the clock is that of
    ``clock_getcpuclockid`` (posix-timers.h of the kernel: the complement of the process, and a kind).
    """
    scheduled = 2  # CPUCLOCK_SCHED, the time of all threads
    return 0.0 if pid is None else time.clock_gettime(~pid << 3 | scheduled)
