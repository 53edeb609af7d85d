"""A process of a vector: requests to its share of the environments, kinds of automatic resets, exceptions."""

import multiprocessing
import pickle
import threading

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from app.environments import vector_worker
from app.environments.batch import Batch
from app.environments.environment import PackEnv
from app.environments.vector_worker import Raised, Share, _Environments, serve

CONTEXT = multiprocessing.get_context("spawn")
ROWS = (1, 2)


class Counting(PackEnv):
    """Episodes of two steps without a cell; ``time`` counts the steps of all episodes."""

    def __init__(self):
        super().__init__(objects="can=1")
        self.total, self.in_episode, self.closed = 0, 0, False

    def answer(self):
        state = np.full(15, self.in_episode, dtype=np.float32)
        return {"state": state}, {"placed": [False], "success": False, "time": float(self.total)}

    def reset(self, *, seed=None, options=None):
        self.total, self.in_episode = seed or self.total, 0
        return self.answer()

    def step(self, action):
        self.total, self.in_episode = self.total + 1, self.in_episode + 1
        observation, info = self.answer()
        return observation, float(action[0]), self.in_episode == 2, False, info

    def close(self):
        self.closed = True

    def fail(self):
        raise LookupError("no such thing")


def share_of(mode=AutoresetMode.NEXT_STEP, limit=None):
    return Share(ROWS, Counting, limit, Batch.of(Counting(), 3, CONTEXT), mode)


def step(environments):
    final, batch = environments.step(), environments.share.batch
    state = batch.observations["state"].values[1:, 0]
    return state.tolist(), batch.terminations.values[1:].tolist(), final


def test_environments_are_reset_in_the_step_after_their_end():
    environments = _Environments(share_of())
    batch = environments.share.batch
    batch.actions.values[:, 0] = [3, 4, 5]
    assert step(environments) == ([1, 1], [False, False], {})
    assert batch.rewards.values.tolist() == [0, 4, 5]  # the first environment is that of another process
    assert step(environments) == ([2, 2], [True, True], {})
    assert step(environments) == ([0, 0], [False, False], {})
    assert batch.rewards.values.tolist() == [0, 0, 0] and batch.infos["time"].values.tolist() == [0, 2, 2]
    assert step(environments)[0] == [1, 1]


def test_environments_are_reset_in_the_step_of_their_end():
    environments = _Environments(share_of(AutoresetMode.SAME_STEP))
    step(environments)
    state, ended, final = step(environments)
    assert (state, ended) == ([0, 0], [True, True]) and final.keys() == {1, 2}
    assert final[1]["final_obs"]["state"][0] == 2 and final[1]["final_info"]["time"] == 2
    assert step(environments)[:2] == ([1, 1], [False, False])


def test_environments_that_the_user_resets():
    environments = _Environments(share_of(AutoresetMode.DISABLED, limit=1))
    batch = environments.share.batch
    environments.reset({1: None, 2: None}, None)
    assert step(environments)[:2] == ([1, 1], [False, False])
    assert batch.truncations.values.tolist() == [False, True, True]
    environments.reset({0: None, 2: 9}, {})
    assert batch.infos["time"].values.tolist() == [0, 1, 9]
    assert batch.truncations.values.tolist() == [False, True, False]


def test_attributes_and_methods():
    environments = _Environments(share_of())
    environments.set("total", [5, 6, 7])
    assert environments.call("total", (), {}) == {1: 6, 2: 7}
    assert environments.call("answer", (), {})[2][1]["time"] == 7


class Stubborn(Exception):
    """An exception that cannot be loaded from a pickle."""

    def __init__(self, one, other):
        super().__init__(f"{one} and {other}")


@pytest.mark.parametrize(
    "error, kind", [(LookupError("a and b"), LookupError), (Stubborn("a", "b"), RuntimeError)]
)
def test_exceptions_keep_their_text_and_origin(error, kind):
    try:
        raise error
    except Exception as caught:
        raised = pickle.loads(pickle.dumps(Raised.of(caught))).error  # noqa: S301
    assert type(raised) is kind and "a and b" in str(raised)
    assert "test_exceptions_keep" in raised.__notes__[0]


@pytest.fixture
def parent(monkeypatch):
    """The parent's end of the pipe to a thread that serves."""
    monkeypatch.setattr(vector_worker, "end_with_parent", lambda: None)
    near, far = CONTEXT.Pipe()
    thread = threading.Thread(target=serve, args=(far, share_of()))
    thread.start()
    yield near
    near.close()
    thread.join(5)
    assert not thread.is_alive()


def test_requests_are_answered_until_the_parent_closes(parent):
    parent.send(("reset", {1: 3, 2: 4}, None))
    assert parent.recv() == {}
    parent.send(("call", "total", (), {}))
    assert parent.recv() == {1: 3, 2: 4}


def test_an_exception_is_the_last_answer(parent):
    parent.send(("call", "fail", (), {}))
    assert isinstance(parent.recv().error, LookupError)
