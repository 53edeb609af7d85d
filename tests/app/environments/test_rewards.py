"""Rewards: verdicts at rest only, sums equal the share in place, the potential is that of the true state."""

import numpy as np
import pytest

from app.environments.privileged import PrivilegedState
from app.environments.rewards import TaskReward

FAR = np.array([0.3, 0.0, 0.6])


def put(world, index, position, speed=0.0):
    world._data.joint(f"object{index}").qpos[:3] = position
    world._data.joint(f"object{index}").qvel[:3] = (0, 0, speed)


@pytest.fixture
def reward(cell_world):
    def make(kind="sparse", task="pack"):
        reward = TaskReward(cell_world, PrivilegedState(cell_world), task, kind)
        reward.reset(FAR)
        return reward

    return make


def in_box(world, x):
    return (0.5 + x, 0.27, world.config.box.floor)


def test_nothing_is_earned_by_waiting(reward):
    for kind in ("sparse", "shaped"):
        judgement = reward(kind).step(FAR)
        assert judgement.reward == 0 and not judgement.success and not judgement.placed.any()


def test_the_sum_of_rewards_is_the_share_in_place(cell_world, reward):
    judge = reward()
    put(cell_world, 0, in_box(cell_world, -0.08))
    first = judge.step(FAR)
    put(cell_world, 1, in_box(cell_world, 0.08))
    second = judge.step(FAR)
    assert (first.reward, second.reward) == (0.5, 0.5)
    assert second.success and not first.success
    put(cell_world, 0, (0.4, -0.3, 0.0))
    assert judge.step(FAR).reward == -0.5


def test_no_verdict_while_an_object_moves_or_is_at_the_hand(cell_world, reward):
    judge = reward()
    put(cell_world, 0, in_box(cell_world, 0.0), speed=0.2)
    assert judge.step(FAR).reward == 0
    put(cell_world, 0, in_box(cell_world, 0.0))
    assert judge.step(np.array([0.5, 0.27, 0.08])).reward == 0
    assert judge.step(FAR).reward == 0.5


def test_the_potential_rises_toward_the_goal_and_is_no_gain_over_a_loop(cell_world, reward):
    judge = reward("shaped")
    start = cell_world._data.joint("object0").qpos[:3].copy()
    put(cell_world, 0, (0.45, 0.0, 0.1))
    nearer = judge.step(FAR).reward
    put(cell_world, 0, start)
    back = judge.step(FAR).reward
    assert nearer > 0.01 and nearer + back == pytest.approx(0, abs=1e-9)


def test_the_hand_is_led_to_the_nearest_object(cell_world, reward):
    judge = reward("shaped")
    above = cell_world._data.joint("object0").qpos[:3] + np.array([0, 0, 0.15])
    assert judge.step(above).reward > 0.01


def test_sorting_is_judged_along_the_line(cell_world, reward):
    from manipulation.types import Line

    judge, start, end = reward(task="sort"), np.array(Line().start), np.array(Line().end)
    sizes = [model.size if hasattr(model, "size") else model.height for model in cell_world.config.objects]
    order = np.argsort(sizes)
    for share, index in zip((0.3, 0.7), order, strict=True):
        put(cell_world, index, (*(start + share * (end - start)), 0.0))
    assert judge.step(FAR).placed.any()
