"""Instances of no class are cut and joined where fits confirm it; the fits are given."""

from dataclasses import replace

import numpy as np
import pytest

from perception.inference import recutting
from perception.inference.recutting import (
    CLEAR,
    EXPLAINED,
    LYING,
    WORSE,
    Recutting,
    instance_ids,
    touching_pairs,
)
from perception.types import (
    POSED_CLASSES,
    CameraIntrinsics,
    ObjectDetection,
    ObjectEstimate,
    RgbdFrame,
    SupportPlane,
    unclassified,
)

CAMERA = CameraIntrinsics(12, 4, 4.0, 4.0, 5.5, 1.5)
FRAME = RgbdFrame(0.0, np.zeros((4, 12, 3), np.uint8), np.ones((4, 12), np.float32), CAMERA, np.eye(4))


def columns(first, last):
    mask = np.zeros((4, 12), bool)
    mask[:, first:last] = True
    return mask


def likely_lying(lying):
    p = np.zeros(len(POSED_CLASSES) + 1)
    p[POSED_CLASSES.index(("bottle", "lying"))], p[-1] = lying, 1 - lying
    return p


def seen(id, first, last, lying=0.9):
    return replace(unclassified(columns(first, last), id), pose_probabilities=likely_lying(lying))


def found(id, score):
    made = object.__new__(ObjectEstimate)
    vars(made).update(id=id, score=score)
    return made


class NoNames:
    """Stands in for the networks, which are not asked."""

    def complete(self, frame, plane, detections):
        raise AssertionError("classes are open")

    posed = complete


class Fits:
    """Fits with given scores by id; remembers what was fitted, and what else was in the images."""

    def __init__(self, monkeypatch, scores, unexplained=0.0):
        self.scores, self.rows = scores, []
        monkeypatch.setattr(recutting, "unexplained", lambda points, estimates: unexplained)
        monkeypatch.setattr(recutting, "instance_points", lambda frames, rows, id: np.full((1, 3), float(id)))
        monkeypatch.setattr(recutting, "posed_detections", lambda frames, rows, planes, completer: rows)
        self.recutting = Recutting([FRAME, FRAME], [SupportPlane()], NoNames(), self)

    def __call__(self, rows):
        self.rows.append(rows)
        return [found(id, self.scores[id]) for id in sorted(instance_ids(rows)) if id in self.scores]


def halves(lying=0.9):
    """An object in two halves, and another one apart from them."""
    row = [seen(3, 0, 4, lying), seen(5, 4, 7), ObjectDetection("can", 0.9, columns(9, 12), instance_id=1)]
    return [row, row]


def test_halves_whose_joint_shape_explains_both_are_one(monkeypatch):
    fits = Fits(monkeypatch, {8: 0.9})
    rows, wholes = fits.recutting.joined(halves(), {3, 5}, {3: found(3, 0.7), 5: found(5, 0.8)}, 8)
    assert wholes.keys() == {8} and instance_ids(rows) == {1, 8}
    (whole,) = (d for d in rows[0] if d.instance_id == 8)
    np.testing.assert_array_equal(whole.mask, columns(0, 7))
    (fitted,) = fits.rows
    assert instance_ids(fitted) == {8} and len(fitted[0]) == 2  # what is beside it occludes it


@pytest.mark.parametrize(
    ("scores", "unexplained", "lying"),
    [
        ({}, 0.0, 0.9),
        ({8: 0.79}, 0.0, 0.9),
        ({8: 0.9}, EXPLAINED + 0.01, 0.9),
        ({8: 0.9}, 0.0, LYING - 0.01),
    ],
    ids=["no-fit", "worse-than-a-half", "not-both-explained", "one-does-not-lie"],
)
def test_else_they_stay_as_they_are(monkeypatch, scores, unexplained, lying):
    fits = Fits(monkeypatch, scores, unexplained)
    before = halves(lying)
    rows, wholes = fits.recutting.joined(before, {3, 5}, {3: found(3, 0.7), 5: found(5, 0.8)}, 8)
    assert not wholes and instance_ids(rows) == {1, 3, 5}


@pytest.mark.parametrize("beyond", [-0.01, 0.01])
def test_what_is_no_object_alone_may_make_a_joint_shape_a_little_less_likely(monkeypatch, beyond):
    fits = Fits(monkeypatch, {8: 0.9 - WORSE + beyond})
    _, wholes = fits.recutting.joined(halves(), {3, 5}, {3: found(3, 0.9)}, 8)
    assert bool(wholes) == (beyond > 0)


@pytest.mark.parametrize("beyond", [-0.01, 0.01])
def test_what_is_joined_must_be_clear(monkeypatch, beyond):
    """Also where neither half was an object."""
    fits = Fits(monkeypatch, {8: CLEAR + beyond})
    _, wholes = fits.recutting.joined(halves(), {3, 5}, {}, 8)
    assert bool(wholes) == (beyond > 0)


def test_an_instance_belongs_to_one_pair(monkeypatch):
    fits = Fits(monkeypatch, {10: 0.9, 12: 0.9})
    row = [seen(3, 0, 4), seen(4, 4, 8), seen(5, 8, 12)]
    rows, wholes = fits.recutting.joined([row, row], {3, 4, 5}, {}, 10)
    assert wholes.keys() == {10} and instance_ids(rows) == {5, 10}


def test_what_was_joined_is_joined_with_what_it_touches_in_turn(monkeypatch):
    """A bottle whose cap and label have colours of their own."""
    fits = Fits(monkeypatch, {10: 0.85, 11: 0.9})
    lies = seen(0, 0, 1).pose_probabilities
    monkeypatch.setattr(
        recutting,
        "posed_detections",
        lambda frames, rows, planes, completer: [
            [replace(d, pose_probabilities=lies) for d in r] for r in rows
        ],
    )
    row = [seen(3, 0, 4), seen(4, 4, 8), seen(5, 8, 12)]
    rows, wholes = fits.recutting.joined([row, row], {3, 4, 5}, {}, 10)
    assert wholes.keys() == {11} and instance_ids(rows) == {11}, "the last one replaces that of the two"
    np.testing.assert_array_equal(rows[0][0].mask, columns(0, 12))


def test_masks_must_touch_in_half_of_the_views_that_show_both():
    near, apart = [seen(1, 0, 3), seen(2, 3, 6)], [seen(1, 0, 3), seen(2, 9, 12)]
    alone = [seen(1, 0, 3)]
    assert touching_pairs([near, apart, alone], {1, 2}) == [(1, 2)]
    assert touching_pairs([near, apart, apart], {1, 2}) == []
    assert touching_pairs([near], {1}) == []


def test_pieces_replace_the_instance_and_are_fitted_alone(monkeypatch):
    fits = Fits(monkeypatch, {6: 0.9})
    cut = [[halves()[0][2], seen(6, 0, 4), seen(7, 4, 7)]] * 2
    monkeypatch.setattr(recutting, "clean_frame", lambda frame: frame)
    monkeypatch.setattr(recutting, "touching_pieces", lambda *_: cut)
    rows, pieces = fits.recutting.separated(halves(), {3}, 6)
    assert instance_ids(rows) == {1, 6, 7} and pieces.keys() == {6}
    (fitted,) = fits.rows
    assert instance_ids(fitted) == {6, 7} and len(fitted[0]) == 3


def test_without_instances_or_pieces_nothing_is_fitted(monkeypatch):
    fits = Fits(monkeypatch, {})
    monkeypatch.setattr(recutting, "clean_frame", lambda frame: frame)
    monkeypatch.setattr(recutting, "touching_pieces", lambda frames, rows, *_: rows)
    before = halves()
    assert fits.recutting.separated(before, set(), 6) == (before, {})
    assert fits.recutting.separated(before, {3}, 6) == (before, {})
    assert not fits.rows


@pytest.mark.parametrize("is_kept", [True, False])
def test_masks_on_which_the_views_agree_replace_those_that_no_shape_explains(monkeypatch, is_kept):
    fits = Fits(monkeypatch, {3: 0.9})
    trimmed = [[seen(3, 0, 2)], []]
    monkeypatch.setattr(
        recutting, "agreed_masks", lambda views, rows, ids: trimmed if ids == {3} else [[], []]
    )
    before = halves()
    rows, agreed = fits.recutting.agreed(before, {3}, lambda e: is_kept and e.score > 0.8)
    (fitted,) = fits.rows
    assert instance_ids(fitted) == {3} and len(fitted[0]) == 3  # what is beside it occludes it
    assert agreed.keys() == ({3} if is_kept else set())
    masks = [[d.mask.sum() for d in row if d.instance_id == 3] for row in rows]
    assert masks == ([[8], []] if is_kept else [[16], [16]]), "the second view shows something else"
    assert instance_ids(rows) == {1, 3, 5}
    assert fits.recutting.agreed(before, {5}, lambda e: True) == (before, {})
    assert fits.recutting.agreed(before, set(), lambda e: True) == (before, {})


@pytest.fixture
def two_colors(monkeypatch):
    """Each instance is of two colours, its left and right half; the second view shows the left one alone."""

    def color_pieces(shown):
        def halves(view):
            u = np.argwhere(view.mask)[:, 1]
            left = view.mask & (np.arange(12) < (u.min() + u.max() + 1) / 2)
            return left, view.mask & ~left

        pieces = {k: halves(view) for k, view in shown.items()}
        return pieces | {1: (pieces[1][0], np.zeros((4, 12), bool))}

    monkeypatch.setattr(recutting, "color_pieces", color_pieces)
    monkeypatch.setattr(recutting, "MIN_PIXELS", 1)


def naming(monkeypatch, lying):
    """Let the network name pieces, with the probability of a lying bottle of each."""

    def posed(frames, rows, planes, completer):
        return [
            [replace(d, pose_probabilities=likely_lying(lying[d.instance_id])) for d in row] for row in rows
        ]

    monkeypatch.setattr(recutting, "posed_detections", posed)


def test_what_touches_without_a_crease_is_parted_by_colour(monkeypatch, two_colors):
    """Together with what it touches, no piece need look as if it lay."""
    fits = Fits(monkeypatch, {10: 0.9, 11: 0.4})
    naming(monkeypatch, {10: LYING + 0.1, 11: LYING + 0.1, 12: LYING + 0.1, 13: LYING - 0.1})
    kept = lambda e, rows: e.score > 0.5 and e.id in instance_ids(rows)  # noqa: E731
    rows, objects = fits.recutting.parted(halves(LYING - 0.1), {3, 5}, 10, kept)
    assert objects.keys() == {10} and instance_ids(rows) == {1, 5, 10, 11}, "nothing of 5 is an object"
    masks = {d.instance_id: d.mask for d in rows[0]}
    np.testing.assert_array_equal(masks[10], columns(0, 2))
    np.testing.assert_array_equal(masks[11], columns(2, 4))
    assert 11 not in instance_ids([rows[1]])
    (fitted,) = fits.rows
    assert instance_ids(fitted) == {10, 11, 12}


def test_what_has_no_lying_piece_or_one_colour_is_not_parted(monkeypatch, two_colors):
    fits = Fits(monkeypatch, {10: 0.9})
    naming(monkeypatch, {10: LYING - 0.1, 11: LYING - 0.1})
    before = halves()
    assert fits.recutting.parted(before, {3}, 10, lambda *_: True) == (before, {}) and not fits.rows
    monkeypatch.setattr(recutting, "color_pieces", lambda shown: None)
    assert fits.recutting.parted(before, {3, 5}, 10, lambda *_: True) == (before, {}) and not fits.rows
