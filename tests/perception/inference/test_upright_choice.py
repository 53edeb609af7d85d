"""Which of several upright fits is kept, for given scores and evidence."""

from dataclasses import fields, replace

import numpy as np
import pytest

from perception.errors import PerceptionError
from perception.inference.acceptance import AcceptanceModel
from perception.inference.evidence import Evidence
from perception.inference.fit import FitFailedError
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectViews
from perception.inference.scored_fits import ObjectFits, ScoredFit
from perception.inference.upright_choice import POOR_DEPTH, best_upright, in_poor_depth, likely_classes
from perception.types import CATEGORIES, ObjectEstimate, SupportPlane, TriangleMesh

EVIDENCE = replace(Evidence(*[0.5] * len(fields(Evidence))), explained=1.0, free_space=0.0, residual=1.0)


def scored(category, score, explained=0.9, residual=1.0, probability=0.4) -> ScoredFit:
    mesh = TriangleMesh(np.eye(3), np.arange(3)[None])
    estimate = ObjectEstimate(3, category, np.zeros(16), np.eye(4), np.ones(3), mesh, score)
    return ScoredFit(estimate, replace(EVIDENCE, explained=explained, residual=residual), probability)


@pytest.fixture
def fits(decoder, table):
    """Fits of a mug that may be a can."""
    views = ObjectViews(3, "mug", 0.5, tuple(table.observations((0.0,))), np.array([0.5, 0.0, 0.0, 0.4, 0.1]))
    return ObjectFits(views, decoder, SupportPlane(), AcceptanceModel({}, 0.4), FitConfig())


@pytest.fixture
def table(make_table):
    return make_table("can", (1.0, 0.5), yaw=0.0)


@pytest.mark.parametrize(
    ("other", "kept"),
    [
        (scored("can", 0.75), "mug"),  # the score decides
        (scored("can", 0.9, probability=0.2), "can"),
        (scored("can", 0.75, explained=0.95, residual=0.8, probability=0.45), "can"),  # all else for the can
        (scored("can", 0.65, explained=0.95, residual=0.8, probability=0.45), "mug"),
        (scored("can", 0.75, explained=0.85, residual=0.8, probability=0.45), "mug"),
        (scored("can", 0.75, explained=0.95, residual=1.2, probability=0.45), "mug"),
        (scored("can", 0.75, explained=0.95, residual=0.8, probability=0.35), "mug"),
    ],
    ids=["score", "higher", "surpassed", "much-lower", "explains-less", "less-closely", "less-probable"],
)  # fmt: skip
def test_a_fit_gives_way_to_one_of_a_more_probable_class_that_explains_the_depth_better(
    fits, monkeypatch, other, kept
) -> None:
    monkeypatch.setattr(ObjectFits, "fit", lambda self, category, *_: other)
    best = best_upright(fits, scored("mug", 0.8), ["can"])
    assert best is not None and best.estimate.category == kept


def test_no_fit_at_all_leaves_none(fits, monkeypatch) -> None:
    def fail(self, category, *_):
        raise FitFailedError("the fit failed")

    monkeypatch.setattr(ObjectFits, "fit", fail)
    assert best_upright(fits, None, ["can"]) is None
    assert in_poor_depth(fits) is None
    with pytest.raises(PerceptionError):
        fits.fit("can")


@pytest.mark.parametrize(
    ("level", "share", "is_fitted"), [(255, 0.6, True), (255, 0.4, False), (240, 1.0, False)]
)
def test_the_depth_of_overexposed_surfaces_is_trusted_less(
    fits, monkeypatch, level, share, is_fitted
) -> None:
    asked = []

    def fit(self, category, resting="upright", toward=None, depth_sigma=None):
        asked.append((category, resting, depth_sigma))
        return scored(category, 0.5)

    monkeypatch.setattr(ObjectFits, "fit", fit)
    (seen,) = fits.views.observations
    rgb = np.zeros_like(seen.frame.rgb)
    rows, columns = np.nonzero(seen.mask)
    bright = slice(0, int(share * len(rows)))
    rgb[rows[bright], columns[bright], 1] = level  # one channel is enough
    bright_seen = replace(seen, frame=replace(seen.frame, rgb=rgb))
    made = in_poor_depth(replace(fits, views=replace(fits.views, observations=(bright_seen,))))
    assert (made is not None) is is_fitted
    assert (
        asked == [("mug", "upright", POOR_DEPTH)] * is_fitted and FitConfig().noise.depth_sigma < POOR_DEPTH
    )


def test_likely_classes_are_ordered_and_leave_out_no_class_and_what_is_ruled_out() -> None:
    assert likely_classes(np.array([0.01, 0.2, 0.3, 0.09, 0.4])) == ("bottle", "bowl", "can")
    assert likely_classes(np.array([0.0, 0.0, 0.0, 0.0, 1.0])) == ()
    assert set(likely_classes(np.full(5, 0.2))) == set(CATEGORIES)
