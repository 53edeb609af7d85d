"""What the environments of a vector receive and return, in memory that several processes share."""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from multiprocessing.context import SpawnContext
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Shaped

from app.environments.environment import CellEnv


class SharedArray:
    """An array in shared memory, of zeros at first; a process that is started with it sees the same contents.

    Attributes:
        values: The array.
    """

    def __init__(self, context: SpawnContext, shape: tuple[int, ...], dtype: Any) -> None:
        self._shape, self._dtype = shape, np.dtype(dtype)
        self._memory = context.RawArray(ctypes.c_byte, max(math.prod(shape), 1) * self._dtype.itemsize)
        self.values = self._view()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "values"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.values = self._view()

    def _view(self) -> Shaped[np.ndarray, "..."]:
        count = math.prod(self._shape)
        memory: Any = self._memory
        return np.frombuffer(memory, dtype=self._dtype, count=count).reshape(self._shape)


@dataclass(frozen=True)
class Batch:
    """Actions and results of one step; the first axis of every array is that of the environments.

    Attributes:
        actions: Actions.
        rewards: Rewards.
        terminations: Whether each episode has reached its goal.
        truncations: Whether each episode was ended for another reason.
        observations: Entries of the observations by name.
        infos: Entries of the dictionaries with further information by name.
    """

    actions: SharedArray
    rewards: SharedArray
    terminations: SharedArray
    truncations: SharedArray
    observations: dict[str, SharedArray]
    infos: dict[str, SharedArray]

    @staticmethod
    def of(env: CellEnv, count: int, context: SpawnContext) -> Batch:
        """Return zeros for ``count`` environments like ``env``."""

        def array(shape: tuple[int, ...], dtype: Any) -> SharedArray:
            return SharedArray(context, (count, *shape), dtype)

        def array_of(space: spaces.Space[Any]) -> SharedArray:
            assert space.shape is not None
            return array(space.shape, space.dtype)

        return Batch(
            array_of(env.action_space),
            array((), np.float64),
            array((), np.bool_),
            array((), np.bool_),
            {name: array_of(space) for name, space in env.entries.items()},
            {
                "placed": array((env.n_objects,), np.bool_),
                "success": array((), np.bool_),
                "time": array((), np.float64),
            },
        )

    def write(self, row: int, observation: dict[str, np.ndarray], info: dict[str, Any]) -> None:
        """Store what an environment observes."""
        for name, array in self.observations.items():
            array.values[row] = observation[name]
        for name, array in self.infos.items():
            array.values[row] = info[name]

    def write_outcome(self, row: int, reward: float, terminated: bool, truncated: bool) -> None:
        """Store how a step of an environment ended."""
        self.rewards.values[row] = reward
        self.terminations.values[row] = terminated
        self.truncations.values[row] = truncated

    def read_observations(self) -> dict[str, np.ndarray]:
        """Return a copy of all observations."""
        return {name: array.values.copy() for name, array in self.observations.items()}

    def read_infos(self, valid: Bool[np.ndarray, "n"]) -> dict[str, Any]:
        """Return further information in Gymnasium's form: by name, and ``_name`` for whether it is valid.

        Args:
            valid: Whether it was written for each environment; elsewhere it is zero.
        """
        infos: dict[str, Any] = {}
        for name, array in self.infos.items():
            infos[name] = array.values.copy()
            infos[name][~valid] = 0
            infos[f"_{name}"] = valid.copy()
        return infos
