"""Prior on the direction of a handle from yaw distributions."""

from dataclasses import replace

import numpy as np
import pytest

from perception.detection.yaw import bin_centres
from perception.inference.yaw_prior import yaw_modes, yaw_prior
from perception.types import SupportPlane

PLANE = SupportPlane()


def peak(yaw: float, spread: float = np.deg2rad(7.0)) -> np.ndarray:
    p = np.exp(-0.5 * (((bin_centres() - yaw + np.pi) % (2 * np.pi) - np.pi) / spread) ** 2)
    return p / p.sum()


@pytest.fixture
def views(make_table):
    """A function that returns views with yaw distributions."""
    seen = make_table("mug", (), yaw=1.0).observations((0.0,))[0]
    return lambda *distributions: [replace(seen, yaw_probabilities=p) for p in distributions]


def test_a_handle_in_plain_view_is_certain(views):
    prior = yaw_prior(views(peak(1.03), peak(1.05)), PLANE)
    assert prior.directions.shape == (1, 3)
    assert np.arctan2(*prior.directions[0, 1::-1]) == pytest.approx(1.04, abs=0.01)
    assert prior.certainties[0] > 0.95


def test_two_modes_share_the_certainty(views):
    prior = yaw_prior(views(0.6 * peak(1.0) + 0.4 * peak(-2.0)), PLANE)
    yaws = np.arctan2(prior.directions[:, 1], prior.directions[:, 0])
    assert yaws == pytest.approx([1.0, -2.0], abs=0.02)
    uniform = 5 / 36
    assert prior.certainties == pytest.approx((np.array([0.6, 0.4]) - uniform) / (1 - uniform), abs=0.03)


def test_a_wide_mode_is_less_certain(views):
    """Twice as wide as one that counts in full: a quarter, of the share that is near."""
    certainty = yaw_prior(views(peak(1.0, np.deg2rad(18.0))), PLANE).certainties[0]
    assert 0.15 < certainty < 0.3


def test_a_uniform_distribution_says_nothing(views):
    assert yaw_prior(views(np.full(36, 1 / 36)), PLANE).certainties == pytest.approx(0.0, abs=1e-12)


def test_without_a_distribution_there_is_no_prior(views):
    for given in ((), (np.zeros(0),), (np.zeros(36),), (np.full(36, np.nan),)):
        assert yaw_prior(views(*given), PLANE) is None
        assert yaw_modes(views(*given)) == []


@pytest.mark.parametrize("bins", [1, 2, 3, 12])
def test_coarse_distributions_have_a_prior(views, bins):
    """Those of users: all the probability in one bin."""
    (certainty,) = yaw_prior(views(np.eye(bins)[0]), PLANE).certainties
    assert certainty == pytest.approx(float(bins > 1), abs=2e-3)
