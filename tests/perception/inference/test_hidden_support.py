"""What is over something that its masks do not show is estimated where it is; on the plane it stays there."""

from dataclasses import replace

import numpy as np
import pytest

from perception.inference import hidden_support
from perception.inference.acceptance import AcceptanceModel
from perception.inference.hidden_support import CUT_OFF, cut_off, on_hidden_supports
from perception.inference.observation import ObjectObservation, ObjectViews
from perception.types import SupportPlane

PLANE = SupportPlane()
PROBABILITIES = np.array([0.01, 0.0, 0.0, 0.98, 0.01])


def examine(views, decoder, estimates=None):
    return on_hidden_supports([views], estimates or {}, {5: PLANE}, decoder, AcceptanceModel.load())


@pytest.fixture(scope="module")
def upper(stack):
    """A can on another one, whose pixels are in no mask."""
    seen = [ObjectObservation(s.frame, mask) for s, mask in zip(stack.seen, stack.upper)]
    return ObjectViews(5, "can", 0.9, tuple(seen), PROBABILITIES)


def test_an_object_over_what_no_mask_shows_is_above_the_plane(upper, stack, decoder) -> None:
    found = examine(upper, decoder)
    heights = found[5].mesh_world.vertices[:, 2]
    assert heights.min() == pytest.approx(stack.height, abs=0.006)
    assert (found[5].resting, found[5].rests_on) == ("upright", None)


def behind_a_wall(views, nearer):
    """The same views with the depth below the lower edge nearer by a distance [m], where it is nothing's."""
    hidden = []
    for seen in views.observations:
        depth, rows = seen.frame.depth.copy(), np.nonzero(seen.mask.any(axis=1))[0]
        below = ~seen.mask & (np.arange(len(depth)) > rows.mean())[:, None]
        depth[below] = np.median(depth[seen.mask]) - nearer
        hidden.append(replace(seen, frame=replace(seen.frame, depth=depth)))
    return replace(views, observations=tuple(hidden))


def test_what_something_nearer_cuts_off_may_stand_on_the_plane(upper, decoder) -> None:
    """The same can is raised with nothing before it: its base is not where its masks end."""
    assert cut_off(upper, PLANE) < CUT_OFF / 2
    behind = behind_a_wall(upper, 0.05)
    assert cut_off(behind, PLANE) > 0.9 and examine(behind, decoder) == {}
    assert cut_off(behind_a_wall(upper, -0.1), PLANE) < CUT_OFF / 2, "what is farther away hides nothing"


def test_what_does_not_stand_upright_is_left_as_it_is(upper, decoder) -> None:
    lying = replace(examine(upper, decoder)[5], resting="lying")
    assert examine(upper, decoder, {5: lying}) == {}


def test_an_object_on_the_plane_is_not_raised(make_table, decoder, monkeypatch) -> None:
    """Neither by its lowest points, nor, where these are hidden, by its misfit."""
    table = make_table("can", (1.5, -1.0), yaw=0.0)
    views = ObjectViews(5, "can", 0.9, tuple(table.observations((0.0, 2.1))), PROBABILITIES)
    assert examine(views, decoder) == {}
    monkeypatch.setattr(hidden_support, "LEAST_BASE", -1.0)
    assert examine(views, decoder) == {}


@pytest.mark.parametrize(
    ("standing", "above", "status", "is_raised"),
    [
        (0.3, 0.19, "converged", True),
        (0.3, 0.21, "converged", False),
        (0.3, 0.21, "not_converged", True),
        (0.25, 0.22, "not_converged", False),
        (0.6, 0.26, "converged", False),  # explained too little
        (0.14, 0.05, "not_converged", False),  # the plane explains it: the foot of a bottle, seen from above
        (0.14, 0.02, "not_converged", True),
        (0.04, 0.001, "not_converged", False),  # a difference of a few pixels
        (0.14, 0.13, "implausible", True),  # no shape of the class reaches the plane
        (0.14, 0.15, "implausible", False),
    ],
)
def test_it_is_raised_where_it_explains_clearly_more(
    upper, decoder, monkeypatch, standing, above, status, is_raised
) -> None:
    fitted = hidden_support.scored_fit

    def fit(views, decoder, plane, model, config):
        made = fitted(views, decoder, plane, model, config)
        is_above = plane.offset > 0
        share = 1 - (above if is_above else standing)
        return replace(
            made,
            estimate=replace(made.estimate, status="converged" if is_above else status),
            evidence=replace(made.evidence, explained=share, free_space=0.0),
        )

    monkeypatch.setattr(hidden_support, "scored_fit", fit)
    assert (5 in examine(upper, decoder)) is is_raised
