"""Vectors: the episodes of single environments in any number of processes; errors, deaths, interrupts."""

import os
import signal
import subprocess
import sys
import time

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from app.environments.environment import PackEnv
from app.environments.registration import register_environments
from app.environments.vector import CellVectorEnv
from app.errors import UsageError
from sim_assets.processes import ROOT

OPTIONS = {"objects": "can=1", "privileged": True, "reward": "shaped"}
COUNT, LIMIT = 3, 3


class Faulty(PackEnv):
    """An environment with a method that raises an error."""

    def fail(self):
        raise LookupError("no such thing")


def faulty():
    return Faulty(**OPTIONS)


@pytest.fixture(scope="module")
def envs():
    """Two environments in one process, the third in another."""
    envs = CellVectorEnv(COUNT, faulty, workers=2, max_episode_steps=LIMIT)
    yield envs
    envs.close()


def gymnasiums_own():
    """Gymnasium's vector in this process."""

    def make():
        return gymnasium.wrappers.TimeLimit(PackEnv(**OPTIONS), LIMIT)

    return SyncVectorEnv([make] * COUNT)


def assert_equal(one, other):
    """Compare tuples, dictionaries and arrays."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for name, value in one.items():
            assert_equal(value, other[name])
    elif isinstance(one, tuple):
        for pair in zip(one, other, strict=True):
            assert_equal(*pair)
    else:
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype


def test_episodes_are_those_of_single_environments(envs):
    """Through a reset of one environment, the end of episodes, and into the next ones with drawn seeds."""
    single = gymnasiums_own()
    assert envs.single_observation_space == single.single_observation_space
    assert envs.observation_space == single.observation_space and envs.action_space == single.action_space
    assert envs.metadata == single.metadata
    vectors = (envs, single)
    home = np.append(PackEnv(**OPTIONS).robot.description.q_home, 0.05)
    noise = np.random.default_rng(0)

    def step():
        actions = (home + noise.uniform(-0.1, 0.1, (COUNT, len(home)))).astype(np.float32)
        results = [vector.step(actions) for vector in vectors]
        assert_equal(*results)
        return results[0]

    first, _ = envs.reset(seed=7)
    assert_equal(first, single.reset(seed=7)[0])
    before = first["state"].copy()
    step()
    np.testing.assert_array_equal(first["state"], before)  # results are copies
    mask = np.array([False, True, False])
    results = [vector.reset(seed=[1, 2, 3], options={"reset_mask": mask}) for vector in vectors]
    assert_equal(*results)
    assert results[0][1]["_time"].tolist() == mask.tolist()
    truncated = [step()[3].tolist() for _ in range(LIMIT)]
    assert truncated == [[False] * 3, [True, False, True], [False, True, False]]
    single.close()


def test_methods_and_attributes_of_the_environments(envs):
    assert envs.get_attr("rate") == (20.0,) * COUNT
    envs.set_attr("rate", [20.0, 21.0, 22.0])
    assert envs.get_attr("rate") == (20.0, 21.0, 22.0)
    envs.set_attr("rate", 20.0)
    assert [states.shape for states in envs.call("object_states")] == [(1, 13)] * COUNT
    assert envs.render() == (None,) * COUNT
    with pytest.raises(UsageError, match=r"the vector's own reset\(\)"):
        envs.call("reset")
    with pytest.raises(ValueError, match="one value or 3, not 2"):
        envs.set_attr("rate", [1.0, 2.0])


@pytest.mark.parametrize("actions", [np.zeros((COUNT, 7)), np.full((COUNT, 8), np.nan), np.zeros(8)])
def test_actions_that_are_none_move_nothing(envs, actions):
    with pytest.raises(UsageError, match=r"\(3, 8\) finite numbers"):
        envs.step(actions)


def test_a_wrong_number_of_seeds_or_entries_of_the_mask(envs):
    for wrong in ({"seed": [1, 2]}, {"options": {"reset_mask": np.ones(COUNT)}}):
        with pytest.raises(ValueError, match="3 seeds"):
            envs.reset(**wrong)


@pytest.mark.parametrize("wrong", [{"num_envs": 0}, {"num_envs": 1, "workers": 0}])
def test_no_environment_or_no_process(wrong):
    with pytest.raises(UsageError, match="at least 1"):
        CellVectorEnv(make=faulty, **wrong)


def test_an_error_of_an_environment_closes_the_vector():
    envs = CellVectorEnv(2, faulty, workers=1, autoreset_mode="SameStep")
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    with pytest.raises(LookupError, match="no such thing") as raised:
        envs.call("fail")
    assert "in fail" in raised.value.__notes__[0]
    assert not any(process.is_alive() for process in envs.processes)
    with pytest.raises(ClosedEnvironmentError, match="step is impossible"):
        envs.step(np.zeros((2, 8)))


def test_the_death_of_a_process_closes_the_vector_of_a_registered_environment():
    register_environments()
    envs = gymnasium.make_vec("nodeslam/Sort-v0", num_envs=1, workers=2, objects="can=1", control="tcp")
    assert envs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP and len(envs.processes) == 1
    assert envs.get_attr("task") == ("sort",) and envs.get_attr("_max_episode_steps") == (4000,)
    os.kill(envs.processes[0].pid, signal.SIGKILL)
    with pytest.raises(RuntimeError, match=r"has ended \(SIGKILL\)$"):
        envs.get_attr("task")
    assert envs.closed


class Stuck:
    """A connection whose process does not answer before the user loses patience."""

    def send(self, request):
        raise KeyboardInterrupt

    def close(self):
        pass


def test_an_interrupt_ends_the_processes_at_once():
    envs = CellVectorEnv(1, faulty)
    envs._connections[:] = [Stuck()]
    with pytest.raises(KeyboardInterrupt):
        envs.call("object_states")
    assert envs.closed and envs.processes[0].exitcode == -signal.SIGTERM


def started(script, program):
    """Start a program as in a terminal: what runs in the background of a script ignores SIGINT."""
    script.write_text(program)
    return subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


RESETS = """
import gymnasium, nodeslam
if __name__ == "__main__":
    envs = gymnasium.make_vec("nodeslam/Pack-v0", num_envs=2, workers=2, objects="can=1")
    envs.get_attr("task")
    print(*(process.pid for process in envs.processes), flush=True)
    while True:
        envs.reset()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_the_processes_end_with_that_of_the_user(tmp_path, number):
    program = started(tmp_path / "script.py", RESETS)
    workers = [int(pid) for pid in program.stdout.readline().split()]
    assert len(workers) == 2
    if number == signal.SIGINT:
        os.killpg(program.pid, number)  # as Ctrl-C does
    else:
        program.kill()
    _, errors = program.communicate(timeout=20)
    assert program.returncode == -number
    assert errors == "" if number == signal.SIGKILL else errors.count("Traceback") == 1
    deadline = time.monotonic() + 10
    while any(os.path.exists(f"/proc/{pid}") for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(os.path.exists(f"/proc/{pid}") for pid in workers)


UNGUARDED = """
import gymnasium, nodeslam
envs = gymnasium.make_vec("nodeslam/Pack-v0", num_envs=1, objects="can=1")
envs.get_attr("task")
"""


def test_the_error_of_a_script_without_a_guard_names_it(tmp_path):
    program = started(tmp_path / "script.py", UNGUARDED)
    _, errors = program.communicate()
    assert program.returncode == 1
    assert "has ended (exit code 1); a script must make the vector below `if __name__" in errors
