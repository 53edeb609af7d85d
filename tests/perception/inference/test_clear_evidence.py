"""Least scores by class, resting pose and, of lying bottles, length."""

import numpy as np
import pytest

from perception.geometry import so3_exp, transform_points
from perception.inference.clear_evidence import (
    BOTTLE_SCORE,
    BROAD,
    FLAT,
    LEAST_SCORE,
    LENGTH,
    LENGTH_POWER,
    LONG,
    NECK,
    PIECE_SCORE,
    POSED_SCORE,
    STUBBY,
    THINNEST,
    UNCLASSIFIED_SCORE,
    is_clear,
    is_thin,
    may_be_part,
    shows_ends,
)
from perception.types import ObjectEstimate, TriangleMesh
from tests.perception.bare_estimates import found


def bottle_score(length, usual=BOTTLE_SCORE):
    """The least score of a lying bottle, by its length in units of LENGTH."""
    return usual / (usual + (1 - usual) * length**LENGTH_POWER)


@pytest.mark.parametrize(
    ("category", "resting", "length", "least"),
    [
        ("can", "upright", LENGTH, UNCLASSIFIED_SCORE),
        ("can", "lying", 2 * LENGTH, POSED_SCORE),
        ("mug", "upside-down", 2 * LENGTH, POSED_SCORE),
        ("bottle", "lying", LENGTH, BOTTLE_SCORE),
        ("bottle", "lying", 0.8 * LENGTH, bottle_score(0.8)),
        ("bottle", "lying", 1.1 * LENGTH, bottle_score(1.1)),
        ("bottle", "lying", 2 * LENGTH, LEAST_SCORE),
    ],
)  # fmt: skip
def test_what_has_no_class_needs_a_score_by_pose_and_class_and_bottles_by_length(
    category, resting, length, least
):
    above, below = (
        found(1, score, category, resting, length=length, radius=0.024)
        for score in (least + 0.01, least - 0.01)
    )
    assert is_clear(above) and not is_clear(below)
    if category == "bottle":
        assert is_clear(found(1, 1.0, category, resting, length=length, radius=0.024))


@pytest.mark.parametrize(("more", "kept"), [(-0.02, False), (0.02, True)])
def test_a_lying_bottle_is_longer_than_wide(more, kept):
    length = (STUBBY + more) * 2 * 0.04
    assert is_clear(found(1, 0.99, "bottle", "lying", length=length, radius=0.04)) == kept
    assert is_clear(found(1, 0.99, "can", "lying", length=length, radius=0.04)), "bottles alone are slender"


@pytest.mark.parametrize(
    ("more", "longer", "kept"), [(-1e-4, -1e-3, False), (1e-4, -1e-3, True), (-1e-4, 1e-3, True)]
)
def test_what_is_as_thin_as_a_handle_must_be_longer(more, longer, kept):
    lying = found(1, 0.99, "bottle", "lying", length=LONG + longer, radius=THINNEST + more)
    assert is_clear(lying) == kept
    assert is_clear(found(1, 0.99, "can", "lying", length=0.1, radius=THINNEST - 1e-3)), "of bottles alone"


@pytest.mark.parametrize(
    ("thin", "broad", "kept"), [(1e-4, 1e-4, True), (-1e-4, 1e-4, False), (1e-4, -1e-4, False)]
)
def test_a_flat_bottle_is_no_handle(thin, broad, kept):
    x, y = BROAD + broad, FLAT + thin
    vertices = np.array([[-x, -y, 0.0], [x, y, 0.0], [0.0, 0.0, 0.15]])
    lying = found(1, 0.99, "bottle", "lying")
    vars(lying).update(mesh=TriangleMesh(vertices, np.array([[0, 1, 2]])))
    assert is_thin(lying) != kept


@pytest.mark.parametrize(
    ("category", "length", "least"),
    [
        ("can", 2 * LENGTH, PIECE_SCORE),
        ("bottle", LENGTH, PIECE_SCORE),
        ("bottle", 1.2 * LENGTH, bottle_score(1.2, PIECE_SCORE)),
        ("bottle", 2 * LENGTH, LEAST_SCORE),
    ],
)
def test_what_may_be_a_part_needs_a_high_score_or_the_length_of_a_bottle(category, length, least):
    above, below = (found(1, least + more, category, "lying", length=length) for more in (0.01, -0.01))
    assert may_be_part(below) and not may_be_part(above)
    assert may_be_part(found(1, PIECE_SCORE - 0.01, "bottle", "upright", length=length)), (
        "length tells of lying ones"
    )


def with_top(share, score, length=LENGTH):
    """A lying bottle whose uppermost quarter has a share of the radius of the rest."""
    bottle = found(1, score, "bottle", "lying", length=length)
    angle, z = np.meshgrid(np.linspace(0, 2 * np.pi, 32), np.linspace(0, length, 40))
    radius = 0.03 * np.where(z > 0.75 * length, share, 1.0)
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1).reshape(-1, 3)
    vars(bottle)["mesh"] = TriangleMesh(vertices, np.array([[0, 1, 2]]))
    return bottle


@pytest.mark.parametrize(
    ("share", "least"),
    [(np.sqrt(NECK) - 0.02, BOTTLE_SCORE), (np.sqrt(NECK) + 0.02, PIECE_SCORE)],
    ids=["neck", "no neck"],
)
def test_a_lying_bottle_without_a_neck_needs_a_higher_score(share, least):
    assert is_clear(with_top(share, least + 0.01)) and not is_clear(with_top(share, least - 0.01))


@pytest.mark.parametrize(
    ("low", "high", "category", "resting", "shown"),
    [
        (True, True, "can", "lying", True),
        (False, True, "can", "lying", False),
        (True, False, "can", "lying", False),
        (False, False, "bottle", "lying", True),
        (False, False, "can", "upright", True),
    ],
)
def test_a_can_that_was_cut_from_a_thing_shows_both_of_its_ends(low, high, category, resting, shown):
    """Ends are measured near the axis: points of the side that are as far along it do not count."""
    rng = np.random.default_rng(3)
    radius, half, n = 0.03, 0.05, 800
    angle = rng.uniform(0, np.pi, n)
    side = np.stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-half, half, n)], axis=1)
    lid = 0.5 * radius * rng.uniform(-1, 1, (40, 3))
    lids = [np.c_[lid[:, :2], np.full(40, end)] for end, seen in ((-half, low), (half, high)) if seen]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3_exp(np.array([0.3, 1.5, 0.0])), (0.5, -0.2, radius)
    corners = np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0
    mesh = TriangleMesh(corners * (radius, radius, half), np.array([[0, 1, 2]]))
    estimate = ObjectEstimate(0, category, np.zeros(16), T, np.ones(3), mesh, resting=resting)
    assert shows_ends(estimate, transform_points(T, np.concatenate([side, *lids]))) is shown
