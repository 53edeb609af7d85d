"""Marginal priors: sums of the views' quadratics, of limited weight."""

import numpy as np
import pytest

from perception.geometry import se3_exp
from perception.inference.problem import FitState
from perception.rendering.pose import ObjectPose
from perception.slam.marginal_prior import MarginalPrior, ViewInformation


@pytest.fixture
def state():
    rng = np.random.default_rng(5)
    rotation = se3_exp(rng.normal(size=6))[:3, :3]
    pose = ObjectPose(rotation, rng.normal(size=3), np.array([0.04, 0.05, 0.06]))
    return FitState(pose, rng.normal(size=16))


def random_views(state, count):
    rng = np.random.default_rng(6)
    views = []
    for _ in range(count):
        J = rng.normal(size=(30, 25))
        views.append(ViewInformation(state.moved(0.01 * rng.normal(size=25)), J.T @ J))
    return views


@pytest.mark.parametrize(("count", "weight"), [(6, 0.5), (2, 1.0)])
def test_the_cost_is_the_weighted_sum_of_the_views(state, count, weight):
    views = random_views(state, count)
    prior = MarginalPrior.of(views, state, max_views=3.0)
    step = 0.01 * np.random.default_rng(7).normal(size=25)
    step[16:19] = 0  # rotations do not add up exactly
    there = state.moved(step)
    errors = [there.step_from(view.state) for view in views]
    cost = weight * sum(e @ view.information @ e for e, view in zip(errors, views))
    assert prior.cost_at(step) == pytest.approx(cost, rel=1e-2)


def test_the_gradient_is_half_of_the_numerical_one(state):
    prior = MarginalPrior.of(random_views(state, 3), state, max_views=4.0)
    step, eps = 0.01 * np.random.default_rng(7).normal(size=25), 1e-6
    numeric = [(prior.cost_at(step + d) - prior.cost_at(step - d)) / (4 * eps) for d in eps * np.eye(25)]
    np.testing.assert_allclose(prior.gradient_at(step), numeric, rtol=1e-4, atol=1e-6)


def test_a_view_at_the_present_state_costs_nothing_there(state):
    prior = MarginalPrior.of([ViewInformation(state, np.eye(25))], state, 4.0)
    assert prior.cost_at(np.zeros(25)) == 0 and prior.cost_at(np.full(25, 2.0)) == 100
    assert not prior.gradient.any()


def test_no_views_make_no_prior(state):
    prior = MarginalPrior.of([], state, 4.0)
    assert prior.cost_at(np.ones(25)) == 0
