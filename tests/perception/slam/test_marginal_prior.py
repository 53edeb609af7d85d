"""Memory of earlier views: the sum of their quadratics, and no more of them than may count."""

import numpy as np
import pytest

from perception.geometry import se3_exp
from perception.inference.problem import FitState
from perception.rendering.pose import ObjectPose
from perception.slam.marginal_prior import Memory, View


def test_memory_is_the_sum_of_what_the_views_want():
    rng = np.random.default_rng(5)
    pose = ObjectPose(se3_exp(rng.normal(size=6))[:3, :3], rng.normal(size=3), np.array([0.04, 0.05, 0.06]))
    state = FitState(pose, rng.normal(size=16))
    views = []
    for _ in range(6):
        J = rng.normal(size=(30, 25))
        views.append(View(state.moved(0.01 * rng.normal(size=25)), J.T @ J))
    memory = Memory.of(views, state, most=3.0)
    step = 0.01 * rng.normal(size=25)
    step[16:19] = 0  # turns do not add up exactly
    there = state.moved(step)
    wanted = [v.state for v in views]
    cost = 0.5 * sum(there.step_from(s) @ v.information @ there.step_from(s) for s, v in zip(wanted, views))
    assert memory.cost_of(step) == pytest.approx(cost, rel=1e-2)
    eps = 1e-6
    numeric = [(memory.cost_of(step + d) - memory.cost_of(step - d)) / (4 * eps) for d in eps * np.eye(25)]
    np.testing.assert_allclose(memory.gradient(step), numeric, rtol=1e-4, atol=1e-6)
