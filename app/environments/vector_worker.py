"""A process of a vector: steps its share of the environments one after the other."""

from __future__ import annotations

import pickle
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import TimeLimit

from app.environments.batch import Batch
from app.environments.environment import CellEnv
from app.workers import end_with_parent

Results = dict[int, Any]  # by number of the environment


@dataclass(frozen=True)
class Share:
    """The environments of one process.

    Attributes:
        rows: Numbers of the environments in the vector.
        make: Importable function that returns an environment.
        max_episode_steps: Steps after which an episode is truncated; None for no limit.
        batch: Actions and results of all environments of the vector.
        autoreset: When an environment whose episode has ended is reset.
    """

    rows: tuple[int, ...]
    make: Callable[[], CellEnv]
    max_episode_steps: int | None
    batch: Batch
    autoreset: AutoresetMode


@dataclass(frozen=True)
class Raised:
    """Exception of a worker, on its path to the parent process."""

    error: Exception

    @staticmethod
    def of(error: Exception) -> Raised:
        """Return the exception with its traceback as a note, or a RuntimeError if it cannot be pickled."""
        note = "in a process of the vector:\n" + "".join(traceback.format_exception(error))
        try:
            pickle.loads(pickle.dumps(error))  # noqa: S301 of this process
        except Exception:
            error = RuntimeError(f"{type(error).__name__}: {error}")
        error.add_note(note)
        return Raised(error)


@dataclass
class _Environments:
    """Environments of a share, with the requests that the parent process makes."""

    share: Share
    envs: dict[int, gymnasium.Env[Any, Any]] = field(init=False)

    def __post_init__(self) -> None:
        limit = self.share.max_episode_steps
        made = {row: self.share.make() for row in self.share.rows}
        self.envs = {**made} if limit is None else {row: TimeLimit(env, limit) for row, env in made.items()}

    def reset(self, seeds: dict[int, int | None], options: dict[str, Any] | None) -> Results:
        """Reset the environments with an entry in ``seeds``."""
        for row, env in self.envs.items():
            if row in seeds:
                self.share.batch.write_outcome(row, 0.0, False, False)
                self.share.batch.write(row, *env.reset(seed=seeds[row], options=options))
        return {}

    def step(self) -> Results:
        """Step all environments; return the last observation and information of those reset in this step."""
        batch, mode, final = self.share.batch, self.share.autoreset, {}
        for row, env in self.envs.items():
            ended = batch.terminations.values[row] or batch.truncations.values[row]
            if ended and mode == AutoresetMode.NEXT_STEP:
                batch.write_outcome(row, 0.0, False, False)
                batch.write(row, *env.reset())
                continue
            observation, reward, terminated, truncated, info = env.step(batch.actions.values[row])
            batch.write_outcome(row, float(reward), terminated, truncated)
            if (terminated or truncated) and mode == AutoresetMode.SAME_STEP:
                final[row] = {"final_obs": observation, "final_info": info}
                observation, info = env.reset()
            batch.write(row, observation, info)
        return final

    def call(self, name: str, arguments: Sequence[Any], keywords: dict[str, Any]) -> Results:
        """Call a method of the environments, or read an attribute."""
        found = {row: env.get_wrapper_attr(name) for row, env in self.envs.items()}
        return {row: it(*arguments, **keywords) if callable(it) else it for row, it in found.items()}

    def set(self, name: str, values: Sequence[Any]) -> Results:
        """Set an attribute of the environments."""
        for row, env in self.envs.items():
            env.set_wrapper_attr(name, values[row])
        return {}

    def close(self) -> None:
        for env in self.envs.values():
            env.close()


def serve(connection: Connection, share: Share) -> None:
    """Do what the parent process requests, until an exception, or until it closes the connection or ends."""
    end_with_parent()
    environments = None
    try:
        environments = _Environments(share)
        while True:
            request, *arguments = connection.recv()
            connection.send(getattr(environments, request)(*arguments))
    except (EOFError, OSError):
        return
    except Exception as error:
        connection.send(Raised.of(error))
    finally:
        if environments is not None:
            environments.close()
