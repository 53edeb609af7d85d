"""Vectors of environments in a few processes: what ``gymnasium.make_vec`` returns for the cell.

Gymnasium's own vector has a process for each environment, and one message to and from each for every step.
Here each process steps several environments; actions, observations, rewards and ``info`` are in shared
memory, and a step is one short message to and from each process.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from multiprocessing.context import SpawnProcess
from typing import Any

import numpy as np
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from app.environments.batch import Batch
from app.environments.environment import CellEnv, Observation, PackEnv, SortEnv
from app.environments.vector_worker import Raised, Results, Share, serve
from app.errors import UsageError
from app.workers import THREAD_POOLS, how_ended, start_without_interrupts

_GRACE = 5.0  # [s] for a process to end before it is killed
Seeds = int | Sequence[int | None] | None


class CellVectorEnv(VectorEnv[Observation, np.ndarray, np.ndarray]):
    """Environments of one kind, stepped together in a few processes.

    Episodes are those of single environments with the same seeds. After an exception, of an environment, of
    the death of a process or of an interrupt, the vector is closed.

    Attributes:
        processes: The processes.
    """

    def __init__(
        self,
        num_envs: int,
        make: Callable[[], CellEnv],
        workers: int | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        """Start the processes.

        Args:
            num_envs: Number of environments.
            make: Importable function that returns an environment.
            workers: Number of processes; one for each core, if None.
            max_episode_steps: Steps after which an episode is truncated; None for no limit.
            autoreset_mode: When an environment is reset after its episode; see Gymnasium's ``AutoresetMode``.

        Raises:
            UsageError: There is to be no environment or no process.
        """
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        workers = cores if workers is None else workers
        if num_envs < 1 or workers < 1:
            raise UsageError(f"num_envs={num_envs}, workers={workers}: give at least 1 of each")
        self.num_envs, self.autoreset_mode = num_envs, AutoresetMode(autoreset_mode)
        model, context = make(), multiprocessing.get_context("spawn")  # a GL context does not survive a fork
        self._batch = Batch.of(model, num_envs, context)
        self.render_mode = model.render_mode
        self.metadata = {**model.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_action_space, self.single_observation_space = model.action_space, model.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        model.close()
        self.processes: list[SpawnProcess] = []
        self._connections: list[Any] = []
        with _single_threaded_children(), self._closed_by_errors():
            for rows in np.array_split(np.arange(num_envs), min(workers, num_envs)):
                share = Share(tuple(rows.tolist()), make, max_episode_steps, self._batch, self.autoreset_mode)
                near, far = context.Pipe()
                self._connections.append(near)
                process = context.Process(target=serve, args=(far, share), daemon=True)
                self.processes.append(process)
                start_without_interrupts(process)
                far.close()  # so that the death of the process is the end of the stream

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Reset the environments, which build their cells at the same time.

        Args:
            seed: Of the first environment, of which the others' follow; or that of each.
            options: ``reset_mask``, if given, has whether each environment is reset.

        Raises:
            ValueError: There is not one seed, or one entry of the mask, for each environment.
        """
        seeds = [seed + row for row in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
        seeds = [None] * self.num_envs if seeds is None else seeds
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if len(seeds) != self.num_envs or mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"give {self.num_envs} seeds, and as many booleans as reset_mask")
        self._ask("reset", {row: seeds[row] for row in np.flatnonzero(mask).tolist()}, options or None)
        return self._batch.read_observations(), self._batch.read_infos(mask)

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Execute an action in each environment for one control period.

        Raises:
            UsageError: The actions are of another shape or not finite; nothing was moved.
        """
        batch, shape = self._batch, self.action_space.shape
        if np.shape(actions) != shape or not np.isfinite(actions).all():
            raise UsageError(f"the actions must hold {shape} finite numbers")
        batch.actions.values[:] = actions
        final = self._ask("step")
        infos = batch.read_infos(np.ones(self.num_envs, dtype=bool))
        for row, info in final.items():
            infos = self._add_info(infos, info, row)
        rewards, ends = batch.rewards.values.copy(), batch.terminations.values.copy()
        return batch.read_observations(), rewards, ends, batch.truncations.values.copy(), infos

    def render(self) -> tuple[Any, ...]:
        """Return an image of each cell; None without ``render_mode="rgb_array"``."""
        return self.call("render")

    def call(self, name: str, *arguments: Any, **keywords: Any) -> tuple[Any, ...]:
        """Return what a method of each environment returns, or the value of an attribute."""
        if name in ("reset", "step", "close"):
            raise UsageError(f"call the vector's own {name}()")
        results = self._ask("call", name, arguments, keywords)
        return tuple(results[row] for row in range(self.num_envs))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of each environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute to the same value in all environments, or to one of a list in each."""
        values = list(values) if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ValueError(f"give one value or {self.num_envs}, not {len(values)}")
        self._ask("set", name, values)

    def close_extras(self, terminate: bool = False, **_: Any) -> None:
        """End the processes; with ``terminate``, without waiting for what they are doing."""
        for connection in self._connections:
            connection.close()  # they return
        if terminate:
            for process in self.processes:
                process.terminate()
        for process in self.processes:
            process.join(_GRACE)
            if process.is_alive():
                process.kill()
                process.join()

    def _ask(self, request: str, *arguments: Any) -> Results:
        """Send a request to all processes, and return their results.

        Raises:
            ClosedEnvironmentError: The vector is closed.
            RuntimeError: A process has died.
            Exception: That of an environment.
        """
        if self.closed:
            raise ClosedEnvironmentError(f"the vector is closed; {request} is impossible")
        results: Results = {}
        with self._closed_by_errors():
            for connection in self._connections:
                with contextlib.suppress(OSError):  # its process has died, or failed to make the environments
                    connection.send((request, *arguments))
            for connection, process in zip(self._connections, self.processes, strict=True):
                reply = self._receive(connection, process)
                if isinstance(reply, Raised):
                    raise reply.error
                results |= reply
        return results

    def _receive(self, connection: Any, process: Any) -> Any:
        try:
            return connection.recv()
        except (EOFError, OSError):
            process.join(_GRACE)
            end = how_ended(process)
            hint = "; a script must make the vector below `if __name__ == '__main__':`"
            raise RuntimeError(
                f"a process of the vector has ended ({end}){hint if end == 'exit code 1' else ''}"
            ) from None

    @contextlib.contextmanager
    def _closed_by_errors(self) -> Iterator[None]:
        """Close the vector if an exception leaves the context: results of some environments are missing."""
        try:
            yield
        except BaseException:
            self.close(terminate=True)
            raise


@contextlib.contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Let the processes that are started in the context have thread pools of one thread."""
    before = {name: os.environ.get(name) for name in THREAD_POOLS}
    os.environ.update(dict.fromkeys(THREAD_POOLS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _vector_of(kind: type[CellEnv], num_envs: int, workers: int | None, **options: Any) -> CellVectorEnv:
    own = {name: options.pop(name) for name in ("max_episode_steps", "autoreset_mode") if name in options}
    return CellVectorEnv(num_envs, partial(kind, **options), workers, **own)


def pack_vector(num_envs: int = 1, workers: int | None = None, **options: Any) -> CellVectorEnv:
    """Return a vector of ``nodeslam/Pack-v0``; options are those of ``PackEnv`` and ``CellVectorEnv``."""
    return _vector_of(PackEnv, num_envs, workers, **options)


def sort_vector(num_envs: int = 1, workers: int | None = None, **options: Any) -> CellVectorEnv:
    """Return a vector of ``nodeslam/Sort-v0``; options are those of ``SortEnv`` and ``CellVectorEnv``."""
    return _vector_of(SortEnv, num_envs, workers, **options)
