"""What remains of the estimates in clutter; explained points and shared volumes are given."""

import numpy as np
import pytest

from perception.inference import selection
from perception.inference.clear_evidence import PIECE_SCORE
from perception.inference.selection import (
    CONTINUED,
    INSIDE,
    REPEATED,
    without_parts,
    without_repeated_stacks,
    without_repetitions,
)
from perception.types import ObjectDetection
from tests.perception.bare_estimates import FRAME, MASK, found


def by_id(*estimates):
    return {e.id: e for e in estimates}


@pytest.fixture
def shares(monkeypatch):
    """Shares of an instance's points that another estimate leaves unexplained, and of volumes inside it."""
    unexplained: dict[tuple[int, int], float] = {}
    inside: dict[tuple[int, int], float] = {}
    monkeypatch.setattr(selection, "instance_points", lambda frames, rows, id: np.full((1, 3), float(id)))
    monkeypatch.setattr(
        selection,
        "unexplained",
        lambda points, others: min(
            (unexplained.get((int(points[0, 0]), e.id), 1.0) for e in others), default=1.0
        ),
    )
    monkeypatch.setattr(selection, "shared_volume", lambda a, b: inside.get((a.id, b.id), 0.0))
    return unexplained, inside


@pytest.mark.parametrize("beyond", [-0.01, 0.01])
def test_a_candidate_is_not_kept_beside_what_explains_it(shares, beyond):
    """The one with more views is kept, whatever the scores."""
    shares[0][4, 5] = shares[0][5, 4] = REPEATED + beyond
    estimates = by_id(found(4, 0.99, n_views=2), found(5, 0.7, n_views=3))
    kept = without_repetitions([FRAME], [[]], estimates, {4, 5})
    assert kept.keys() == ({5} if beyond < 0 else {4, 5})


@pytest.mark.parametrize("beyond", [-0.01, 0.01])
def test_nor_inside_it(shares, beyond):
    shares[1][4, 1] = INSIDE + beyond
    kept = without_repetitions([FRAME], [[]], by_id(found(1), found(4)), {4})
    assert kept.keys() == ({1, 4} if beyond < 0 else {1})


def test_detected_objects_are_compared_with_parts_of_stacks_alone(shares):
    shares[0][1, 2] = shares[0][2, 1] = shares[0][2, 7] = 0.0
    kept = without_repetitions([FRAME], [[]], by_id(found(1), found(2)), set(), [found(7)])
    assert kept.keys() == {1}


def test_of_two_stacks_that_are_one_that_with_more_views_is_kept(shares):
    shares[0][1, 4] = 0.0
    stacks = {1: (found(2), found(3)), 5: (found(4, n_views=4), found(6))}
    assert without_repeated_stacks([FRAME], [[]], stacks).keys() == {5}


@pytest.mark.parametrize(
    ("score", "share", "kept"),
    [
        (PIECE_SCORE - 0.01, CONTINUED + 0.01, False),
        (PIECE_SCORE - 0.01, CONTINUED - 0.01, True),
        (PIECE_SCORE + 0.01, CONTINUED + 0.01, True),
    ],
)
def test_a_doubtful_candidate_that_goes_on_in_a_thing_is_a_part_of_it(monkeypatch, score, share, kept):
    """The median over its views counts; things are the candidates without an estimate."""
    asked = []

    def continued_shares(frames, rows, things):
        asked.append(([[d.instance_id for d in row] for row in rows], [len(masks) for masks in things]))
        return {4: [0.0, share, 1.0]}

    monkeypatch.setattr(selection, "continued_shares", continued_shares)
    row = [ObjectDetection("can", 0.9, MASK, instance_id=id) for id in (1, 4, 5)]
    result = without_parts([FRAME], [row], by_id(found(1, 0.1), found(4, score)), {4, 5})
    assert result.keys() == ({1, 4} if kept else {1})
    assert asked == ([([[4]], [1])] if score < PIECE_SCORE else [])
