"""Coarse residuals choose the hypotheses that complete fits compare."""

import pytest

from perception.errors import InvalidInputError
from perception.inference import screening
from perception.inference.observation import ObjectViews
from perception.inference.screening import MOST, NEAR, comes_near, nearest_hypotheses
from perception.types import POSED_CLASSES, SupportPlane


@pytest.fixture
def residuals(monkeypatch, can):
    """Sets the coarse residuals in metres by class and pose; the others are large, or cannot be fitted."""
    given = {}

    def coarse_residual(views, decoder, plane, config):
        assert len(views.observations) <= screening.VIEWS
        residual = given.get((views.category, config.resting))
        if residual is None:
            raise InvalidInputError("no view shows the upper side")
        return residual

    monkeypatch.setattr(screening, "coarse_residual", coarse_residual)
    views = ObjectViews(0, "can", 1.0, tuple(can.observations((0.0, 1.0, 2.0, 3.0))))
    return given, views


def test_the_nearest_are_kept_in_order(residuals, decoder):
    given, views = residuals
    given |= {("can", "lying"): 0.005, ("bottle", "lying"): 0.004, ("mug", "upright"): 0.011}
    assert nearest_hypotheses(views, decoder, SupportPlane()) == [("bottle", "lying"), ("can", "lying")]
    given |= dict.fromkeys(POSED_CLASSES, 0.005)
    assert len(nearest_hypotheses(views, decoder, SupportPlane())) == MOST


def test_what_no_shape_comes_near_has_no_hypothesis(residuals, decoder):
    given, views = residuals
    assert nearest_hypotheses(views, decoder, SupportPlane()) == []
    given |= dict.fromkeys(POSED_CLASSES, 1.1 * NEAR)
    assert nearest_hypotheses(views, decoder, SupportPlane()) == []


def test_another_pose_is_compared_with_the_upright_one(residuals, decoder):
    given, views = residuals
    given |= {("can", "upright"): 0.006, ("can", "lying"): 0.005}
    assert comes_near(views, decoder, SupportPlane(), "lying")
    given["can", "lying"] = 0.008
    assert not comes_near(views, decoder, SupportPlane(), "lying")
    del given["can", "lying"]
    assert not comes_near(views, decoder, SupportPlane(), "lying")


def test_an_upright_can_comes_nearer_upright_than_lying(can, decoder):
    """For real: three coarse iterations tell them apart."""
    views = ObjectViews(0, "can", 1.0, tuple(can.observations((0.0, 2.0))))
    assert not comes_near(views, decoder, SupportPlane(), "lying")
