"""What is fitted anew, and which of the new fits replace the old ones."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perception.inference import doubtful_shapes
from perception.inference.doubtful_shapes import POSSIBLE, WORSE, completed, renamed
from perception.inference.stack_choice import CLEARLY
from perception.types import POSED_CLASSES, ObjectDetection, SupportPlane
from tests.perception.bare_estimates import FRAME, MASK, found

DETECTED, BESIDE = (ObjectDetection("can", 0.9, MASK, instance_id=i) for i in (0, 3))


@pytest.mark.parametrize(
    ("can", "resting", "is_renamed"),
    [(0.0, "upright", False), (POSSIBLE, "upright", True), (0.0, "upside-down", True)],
)
def test_the_class_network_may_rule_out_what_stands_upright(monkeypatch, can, resting, is_renamed):
    """A bowl whose fit is poor, of which a can explains much more."""
    bowl, fitted = found(0, category="bowl"), found(0, category="can", resting=resting)
    monkeypatch.setattr(doubtful_shapes, "instance_points", lambda *_: np.zeros((1, 3)))
    monkeypatch.setattr(
        doubtful_shapes, "unexplained", lambda points, shapes: 1.0 if shapes[0] is bowl else 0.0
    )
    views = [np.array([0.0, 1.0 - p, 0.0, p, 0.0]) for p in (0.0, can)]
    rows = [[ObjectDetection("bowl", 1.0, MASK, instance_id=0, class_probabilities=p)] for p in views]
    monkeypatch.setattr(doubtful_shapes, "without_stray_parts", lambda frames, rows, estimates, ids: rows)
    known = renamed([FRAME, FRAME], rows, {0: bowl}, lambda rows: rows, lambda nameless: [fitted])
    assert known == ({0: fitted} if is_renamed else {})


@pytest.mark.parametrize(("after", "is_renamed"), [(0.4, True), (0.6, False)])
def test_what_is_joined_across_a_gap_is_left_out_before_others_are_tried(monkeypatch, after, is_renamed):
    """Without a cable in its mask, a can is a mug upside down if that explains more of what is left."""
    can, mug = found(0, category="can"), found(0, category="mug", resting="upside-down")
    left = ~np.eye(4, dtype=bool)
    shares = {(4, "can"): 1.0, (3, "can"): 1.0, (3, "mug"): CLEARLY * 2 * after}
    monkeypatch.setattr(
        doubtful_shapes,
        "without_stray_parts",
        lambda frames, rows, estimates, ids: [
            [replace(d, mask=left) if d.instance_id in ids else d for d in row] for row in rows
        ],
    )
    monkeypatch.setattr(
        doubtful_shapes,
        "instance_points",
        lambda frames, rows, id: np.zeros((3 if (rows[0][0].mask == left).all() else 4, 3)),
    )
    monkeypatch.setattr(
        doubtful_shapes, "unexplained", lambda points, shapes: shares[len(points), shapes[0].category]
    )
    turned = np.eye(10)[POSED_CLASSES.index(("mug", "upside-down"))]
    fitted = []

    def fit(rows):
        fitted.extend(d for row in rows for d in row)
        return [mug]

    def name(rows):
        return [[replace(d, pose_probabilities=turned) for d in row] for row in rows]

    known = renamed([FRAME], [[replace(DETECTED, support=2), BESIDE]], {0: can}, name, fit)
    assert known == ({0: mug} if is_renamed else {})
    own, beside = fitted
    assert (own.mask == left).all() and own.support == 2 and (own.pose_probabilities == turned).all()
    assert beside.instance_id is None and (beside.mask == MASK).all()


@pytest.mark.parametrize(
    ("category", "resting", "pose", "searched"),
    [
        ("mug", "upside-down", 9, True),
        ("can", "upright", POSED_CLASSES.index(("mug", "upside-down")), True),
        ("can", "upright", POSED_CLASSES.index(("mug", "lying")), True),
        ("mug", "upright", 9, False),
        ("bottle", "lying", 9, True),
        ("can", "upright", POSED_CLASSES.index(("can", "lying")), False),
    ],
)
def test_parts_of_what_does_not_stand_are_looked_for(monkeypatch, category, resting, pose, searched):
    ids = []

    def with_lost_parts(frames, rows, estimates, mugs, plane):
        ids.extend(mugs)
        return {}

    monkeypatch.setattr(doubtful_shapes, "with_lost_parts", with_lost_parts)
    monkeypatch.setattr(doubtful_shapes, "with_lost_ends", lambda *_: {})
    row = [replace(DETECTED, pose_probabilities=np.eye(10)[pose])]
    estimates = {0: found(0, category=category, resting=resting)}
    assert completed((FRAME,), (row,), estimates, SupportPlane(), lambda rows: []) == {}
    assert ids == ([0] if searched else [])


def test_a_completed_mug_replaces_what_explains_less(monkeypatch):
    larger = ~np.eye(4, dtype=bool)
    monkeypatch.setattr(doubtful_shapes, "with_lost_parts", lambda *_: {0: [larger]})
    monkeypatch.setattr(doubtful_shapes, "with_lost_ends", lambda *_: {})
    fitted = []

    def fit(rows):
        fitted.extend((d.instance_id, bool((d.mask == larger).all())) for row in rows for d in row)
        return [found(0, category="mug", resting="upside-down")]

    shares = iter([0.2, 0.1, 0.2, 0.3])
    monkeypatch.setattr(doubtful_shapes, "unexplained", lambda points, shapes: next(shares))
    rows = ((DETECTED, BESIDE),)
    estimates = {0: found(0, category="mug", resting="lying")}
    run: Any = getattr(completed, "__wrapped__", completed)
    better = run((FRAME,), rows, estimates, SupportPlane(), fit)
    assert better[0].category == "mug" and fitted == [(0, True), (None, False)]
    assert run((FRAME,), rows, estimates, SupportPlane(), fit) == {}


@pytest.mark.parametrize(
    ("old", "new", "after", "kept"),
    [
        (("can", "upright"), ("mug", "upside-down"), 0.19, True),
        (("mug", "upside-down"), ("mug", "upside-down"), 0.21, False),
        (("can", "lying"), ("bottle", "lying"), 0.09, True),
        (("bottle", "lying"), ("bottle", "lying"), 0.11, False),  # perhaps of another thing
        (("can", "lying"), ("bottle", "upright"), 0.01, False),
        (("can", "upright"), ("bottle", "lying"), 0.01, False),
    ],
)
def test_lost_parts_of_bottles_must_explain_more_than_handles(old, new, after, kept):
    first, second = (found(0, category=category, resting=resting) for category, resting in (old, new))
    assert doubtful_shapes._has_lost_part(first, second, 0.2, after) == kept
    if new[0] == "bottle":
        second = found(0, first.score - WORSE - 0.01, *new)
        assert not doubtful_shapes._has_lost_part(first, second, 0.2, after), (
            "a neighbour's part makes a poor bottle"
        )


@pytest.mark.parametrize("has_part", [False, True])
def test_ends_are_looked_for_where_no_other_parts_were_found(monkeypatch, has_part):
    larger, largest = ~np.eye(4, dtype=bool), np.ones((4, 4), bool)
    monkeypatch.setattr(doubtful_shapes, "with_lost_parts", lambda *_: {0: [larger]} if has_part else {})
    searched = []

    def with_lost_ends(frames, rows, estimates, ids, plane):
        searched.extend(ids)
        return {id: [largest] for id in ids}

    monkeypatch.setattr(doubtful_shapes, "with_lost_ends", with_lost_ends)
    monkeypatch.setattr(doubtful_shapes, "instance_points", lambda *_: np.zeros((1, 3)))
    shares = iter([0.2, 0.05] if has_part else [0.02, 0.021])
    monkeypatch.setattr(doubtful_shapes, "unexplained", lambda points, shapes: next(shares))
    fitted = []

    def fit(rows):
        fitted.extend(d.mask for row in rows for d in row if d.instance_id == 0)
        return [found(0, category="bottle", resting="lying")]

    estimates = {0: found(0, category="bottle", resting="lying"), 3: found(3, category="bottle")}
    better = completed((FRAME,), ((DETECTED, BESIDE),), estimates, SupportPlane(), fit)
    assert list(better) == [0] and searched == ([] if has_part else [0])
    assert len(fitted) == 1 and (fitted[0] == (larger if has_part else largest)).all()


@pytest.mark.parametrize(
    ("new", "after", "kept"),
    [
        (("bottle", "lying"), 0.022, True),  # an end hardly counts
        (("bottle", "lying"), 0.03, False),
        (("mug", "lying"), 0.0, False),
        (("bottle", "upright"), 0.0, False),
    ],
)
def test_a_bottle_with_its_end_is_the_same_bottle(new, after, kept):
    first, second = found(0, category="can", resting="lying"), found(0, category=new[0], resting=new[1])
    assert doubtful_shapes._has_lost_end(first, second, 0.02, after) == kept
    worse = found(0, first.score - WORSE - 0.01, *new)
    assert not doubtful_shapes._has_lost_end(first, worse, 0.02, after)
