"""Registration with Gymnasium."""

import sys

import gymnasium
import pytest

from app.environments.registration import ENVIRONMENTS, MAX_SECONDS, RATE, register_environments
from app.errors import MissingExtraError


def test_environments_are_registered_once():
    register_environments()
    register_environments()
    for name in ENVIRONMENTS:
        spec = gymnasium.spec(name)
        assert spec.max_episode_steps == MAX_SECONDS * RATE
        assert gymnasium.envs.registration.load_env_creator(spec.entry_point).task in name.lower()
        make = gymnasium.envs.registration.load_env_creator(spec.vector_entry_point)
        assert make.__name__.removesuffix("_vector") in name.lower()


def test_without_gymnasium(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(MissingExtraError, match=r"nodeslam\[gym\]|\[gym\]"):
        register_environments()
