"""An environment and an expert of three steps, and episodes recorded with them."""

import numpy as np
import pytest

from app.collect.lerobot import DatasetConfig
from app.environments.environment import CellEnv
from app.environments.expert import Expert
from app.environments.privileged import COLUMNS


class ShortEnv(CellEnv):
    """Two objects; all are in place after ``length`` actions."""

    rate = 20.0
    categories = ("can", "mug")

    def __init__(self, length=3, images=True):
        self.length, self.with_images = length, images

    def observe(self):
        observation = {"state": np.arange(3, dtype=np.float32) + self.count}
        if self.with_images:
            images = {name: np.full((48, 64, 3), 50 * self.count, np.uint8) for name in ("wrist", "scene")}
            observation |= images
        return observation

    def reset(self, *, seed=None, options=None):
        self.count = 0
        return self.observe(), {"placed": np.zeros(2, bool), "success": False, "time": 0.0}

    def step(self, action):
        self.count += 1
        done = self.count == self.length
        info = {"placed": np.full(2, done), "success": done, "time": 0.05 * self.count}
        return self.observe(), float(done), done, False, info

    def object_states(self):
        return np.full((2, len(COLUMNS)), self.count, np.float32)


class ShortExpert(Expert):
    """Acts ``patience`` times."""

    def __init__(self, patience=99):
        self.patience = patience

    def reset(self, observation):
        self.acted, self.finished, self.phase, self.target, self.failure = 0, False, "scan", "", ""

    def act(self, observation):
        self.finished = self.acted == self.patience
        self.failure = "no plan" if self.finished else ""
        self.acted += 1
        return np.array([self.acted, 0.08], np.float32)


@pytest.fixture
def short():
    """Return a function that makes the environment and the expert."""
    return lambda length=3, images=True, patience=99: (ShortEnv(length, images), ShortExpert(patience))


@pytest.fixture
def config():
    return DatasetConfig(
        robot="panda",
        fps=20,
        instruction="Pack.",
        state_names=("a", "b", "c"),
        action_names=("d", "width"),
        cameras=("wrist", "scene"),
        image_size=(64, 48),
    )
