"""Fits as given classes in given resting poses, with scores."""

from dataclasses import replace

import numpy as np
import pytest

from perception.inference.acceptance import AcceptanceModel, shipped_acceptance
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectViews
from perception.inference.scored_fits import ObjectFits, RejectedError
from perception.types import SupportPlane


@pytest.fixture(scope="module")
def fits(make_table, decoder):
    table = make_table("can", (1.0, 0.5), yaw=0.0)
    p = np.array([0.1, 0.0, 0.0, 0.8, 0.1])
    views = ObjectViews(3, "mug", 0.5, tuple(table.observations((0.0,))), p)
    return ObjectFits(views, decoder, SupportPlane(), AcceptanceModel.load(), FitConfig())


def test_a_fit_has_the_score_of_its_evidence_and_the_probability_of_its_class(fits) -> None:
    made = fits.fit("can")
    assert made.probability == 0.8 and made.estimate.category == "can"
    assert made.estimate.score == fits.model.score(made.evidence, "can", 0.8)


def test_one_view_with_class_probabilities_is_scored_by_the_verifier(fits) -> None:
    model = shipped_acceptance()
    one = replace(fits, model=model)
    made = one.fit("can")
    p = fits.views.class_probabilities
    assert model.verifier is not None
    assert made.estimate.score == model.verifier.score(model.verifier_inputs(made.evidence, "can", p))
    assert made.estimate.score != model.score(made.evidence, "can", 0.8)
    log_odds = [np.log(p / (1 - p)) for p in (made.estimate.score, model.score(made.evidence, "can", 0.8))]
    assert np.log(made.preference / (1 - made.preference)) == pytest.approx(np.mean(log_odds))
    assert one.threshold == model.verifier.threshold
    seen = fits.views.observations[0]
    two = replace(one, views=replace(fits.views, observations=(seen, seen)))
    again = two.fit("can")
    assert (
        again.estimate.score == model.score(again.evidence, "can", 0.8) and two.threshold == model.threshold
    )
    unknown = replace(one, views=replace(fits.views, class_probabilities=np.zeros(0))).fit("can")
    assert unknown.estimate.score == unknown.preference == model.score(unknown.evidence, "can")


def test_the_classes_of_upright_objects_say_nothing_of_other_poses(fits) -> None:
    views = replace(fits.views, class_probabilities=np.full(5, 0.2))
    made = replace(fits, views=views).attempt("can", "upside-down")
    assert made is not None and made.probability is None and made.estimate.resting == "upside-down"


def test_less_trusted_depth_leaves_the_shape_nearer_to_the_mean(fits) -> None:
    near, far = (float(np.linalg.norm(fits.fit("can", depth_sigma=s).estimate.code)) for s in (0.1, None))
    assert near < far


def test_a_rejection_says_score_and_reason() -> None:
    error = RejectedError("can", 0.123, "it floats")
    assert str(error) == "score 0.12: it floats" and (error.category, error.score) == ("can", 0.123)
