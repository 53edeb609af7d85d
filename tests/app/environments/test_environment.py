"""The environments: Gymnasium's own checker, seeds, images, episodes' ends."""

import warnings

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from app.environments.environment import PackEnv, SortEnv
from app.errors import UsageError
from sim_assets.cell.stepping import SimulationError


@pytest.fixture(scope="module")
def env():
    env = PackEnv(objects="can=1", privileged=True)
    env.reset(seed=1)
    yield env
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [PackEnv, SortEnv])
def test_gymnasium_accepts_the_environment(kind):
    env = kind(objects="can=1", images=True, image_size=(32, 24), render_mode="rgb_array", reward="shaped")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns that the environment has no spec
        check_env(env)
    env.close()


def test_equal_seeds_and_actions_give_equal_episodes(env):
    def episode():
        first, _ = env.reset(seed=7)
        noise = np.random.default_rng(0).uniform(-0.05, 0.05, (5, 8))
        actions = noise + np.append(env.robot.description.q_home, 0.05)
        return [first, *(env.step(action.astype(np.float32))[0] for action in actions)]

    for one, other in zip(episode(), episode(), strict=True):
        np.testing.assert_array_equal(one["state"], other["state"])
        np.testing.assert_array_equal(one["objects"], other["objects"])


def test_the_seed_is_that_of_the_command(env):
    from app.options import PackOptions
    from app.task.cell import build_world
    from app.task.scoring import read_truth

    observation, _ = env.reset(seed=7)
    with build_world(PackOptions(objects="can=1", seed=7), "pack") as world:
        np.testing.assert_allclose(
            observation["objects"][0, :3], read_truth(world).poses[0][:3, 3], atol=1e-6
        )


def test_episodes_without_a_seed_differ(env):
    env.reset(seed=3)
    first, second = (env.reset()[0]["objects"] for _ in range(2))
    assert np.abs(first - second).max() > 1e-3


def test_a_step_is_one_control_period(env):
    before = env.reset(seed=1)[1]["time"]
    observation, reward, terminated, truncated, info = env.step(
        np.append(env.cell.control.q, 0.08).astype(np.float32)
    )
    assert info["time"] - before == pytest.approx(1 / env.rate)
    assert (reward, terminated, truncated, info["success"]) == (0.0, False, False, False)
    assert env.observation_space.contains(observation) and info["placed"].tolist() == [False]


def test_a_diverged_simulation_ends_the_episode(env, monkeypatch):
    env.reset(seed=1)

    def diverge(q, width):
        raise SimulationError("the physics diverged")

    monkeypatch.setattr(env.cell.control, "advance", diverge)
    assert env.step(env.action_space.sample())[2:4] == (False, True)


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"objekts": "3"}, "objekts"),
        ({"objects": "cup=1"}, "cup"),
        ({"objects": 6}, "Expected `str`, got `int`"),
        ({"lying": 0.5}, "Expected `int`, got `float`"),
        ({"object_meshes": 3}, "no path"),
        ({"rate": float("nan")}, "1 to 200 actions"),
        ({"image_size": (0, 64)}, "16 to 4096 px"),
        ({"render_mode": "human"}, "rgb_array"),
    ],
)
def test_wrong_options(wrong, message):
    with pytest.raises(UsageError, match=message):
        PackEnv(**wrong)


@pytest.mark.parametrize("action", [np.full(8, np.nan), np.zeros(7), np.zeros((2, 8))])
def test_actions_that_are_none_are_refused(env, action):
    env.reset(seed=1)
    with pytest.raises(UsageError, match="finite numbers"):
        env.step(action)


def test_a_step_before_the_first_reset():
    with pytest.raises(UsageError, match="reset"):
        PackEnv(objects="can=1").step(np.zeros(8, np.float32))
