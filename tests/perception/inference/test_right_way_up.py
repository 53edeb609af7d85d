"""Which end of a can or of a closed cup is up, on cones and barrels of known profiles."""

import numpy as np
import pytest

from perception.inference.observation import ObjectObservation
from perception.inference.right_way_up import (
    EVEN,
    STRAIGHT,
    WIDER,
    is_turned_over,
    side_profile,
    turned_over,
)
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame, TriangleMesh

HEIGHT, RADIUS = 0.1, 0.03


def side(
    slope: float, bulge: float = 0.0, seen: float = 2 * np.pi, low: float = -0.5, tilt: float = 0.0
) -> np.ndarray:
    """Noisy points of r(u) = RADIUS (1 + slope u + bulge u^2) over an angle, and from a height upwards."""
    rng = np.random.default_rng(0)
    angle, u = rng.uniform(0, seen, 4000), rng.uniform(low, 0.5, 4000)
    r = RADIUS * (1 + slope * u + bulge * u**2) + rng.normal(0, 0.002, 4000)
    return np.stack([r * np.cos(angle) + tilt * u, r * np.sin(angle), HEIGHT * u], axis=1)


def widening(points: np.ndarray, may_tilt: bool = True) -> float:
    profile = side_profile(points, cylinder(), may_tilt)
    assert profile is not None
    return profile.widening


def cylinder() -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 60)
    ring = RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.c_[ring, np.full(60, z)] for z in (-HEIGHT / 2, HEIGHT / 2)])


@pytest.mark.parametrize("seen", [0.1 * np.pi, 0.15 * np.pi])
def test_a_narrow_strip_of_a_side_does_not_tell_how_wide_it_is(seen) -> None:
    """Noise makes a cone of it: a cylinder of which 36 degrees were seen seemed to end in a point."""
    for slope in (-0.25, 0.0, 0.25):
        assert side_profile(side(slope, seen=seen), cylinder(), may_tilt=True) is None


@pytest.mark.parametrize("slope", [-0.2, 0.0, 0.2])
@pytest.mark.parametrize("seen", [2 * np.pi, 0.9 * np.pi])
def test_widening_of_a_cone_from_all_sides_and_from_one(slope, seen) -> None:
    assert widening(side(slope, seen=seen)) == pytest.approx(slope, abs=0.06)


def test_a_tilt_of_the_estimate_is_no_widening() -> None:
    assert widening(side(0.0, tilt=0.01, seen=np.pi)) == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize("seen", [2 * np.pi, 0.5 * np.pi])
def test_of_what_stands_a_quarter_of_the_side_suffices(seen) -> None:
    """Where the axis may tilt, a cone seen from one side is a cylinder that leans."""
    assert widening(side(0.15, seen=seen), may_tilt=False) == pytest.approx(0.15, abs=0.03)


def test_of_what_stands_a_part_of_the_side_suffices() -> None:
    """Its lower half is hidden by what is before it."""
    profile = side_profile(side(0.2, low=0.0, seen=0.8 * np.pi), cylinder(), may_tilt=False)
    assert profile is not None and profile.widening == pytest.approx(0.2, abs=0.05)
    assert profile.bulge == 0.0 and 0.0 < profile.deviation < 0.05
    assert side_profile(side(0.2, low=0.0), cylinder(), may_tilt=True) is None, "it may lean"
    assert side_profile(side(0.2, low=0.25), cylinder(), may_tilt=False) is None, "too little is seen"


def test_the_fewer_points_the_less_certain_is_the_widening() -> None:
    many = side_profile(side(0.1), cylinder(), may_tilt=False)
    few = side_profile(side(0.1)[::20], cylinder(), may_tilt=False)
    assert many is not None and few is not None
    assert few.deviation > 1.5 * many.deviation


def test_the_lid_of_a_can_that_is_estimated_too_high_is_no_side() -> None:
    """The mesh reaches a tenth beyond the flat end, which has many more points than the side."""
    rng = np.random.default_rng(1)
    angle, r = rng.uniform(0, 2 * np.pi, 20000), 0.033 * np.sqrt(rng.uniform(0.4, 1, 20000))
    end = np.stack([r * np.cos(angle), r * np.sin(angle), np.full(20000, 0.4 * HEIGHT)], axis=1)
    cone = side(0.2)
    points = np.concatenate([cone[cone[:, 2] < 0.4 * HEIGHT], end])
    assert widening(points, may_tilt=False) == pytest.approx(0.18, abs=0.05)


@pytest.mark.parametrize("bulge", [-0.8, 0.8])
def test_barrels_and_waists_do_not_widen(bulge) -> None:
    """Not even where their lower part was hardly measured."""
    assert widening(side(0.0, bulge)) == pytest.approx(0.0, abs=0.03)
    assert abs(widening(side(0.0, bulge, low=-0.3))) < WIDER


def test_a_wide_neck_makes_a_side_uneven() -> None:
    """Two cylinders and the shoulder between them, in place of the cone through both."""
    cone, points = side(-0.3), side(0.0)
    height = points[:, 2] / HEIGHT
    points[:, :2] *= np.interp(height, (-0.5, -0.1, 0.1, 0.5), (1.15, 1.15, 0.85, 0.85))[:, None]
    even, uneven = (side_profile(p, cylinder(), may_tilt=True) for p in (cone, points))
    assert even is not None and uneven is not None
    assert even.unevenness < 0.03 and uneven.unevenness > EVEN
    assert uneven.widening < -WIDER and abs(uneven.bulge) < STRAIGHT


def test_without_measurements_of_both_ends_nothing_is_known() -> None:
    assert side_profile(side(0.2, low=-0.1), cylinder(), may_tilt=True) is None
    assert side_profile(np.zeros((0, 3)), cylinder(), may_tilt=True) is None


def test_the_profile_is_that_of_the_body() -> None:
    profile = side_profile(side(0.2, -0.6), cylinder(), may_tilt=True)
    assert profile is not None
    assert (profile.radius, profile.bulge) == (pytest.approx(RADIUS, rel=0.03), pytest.approx(-0.6, abs=0.1))


def test_flat_ends_and_what_is_far_from_the_side_do_not_count() -> None:
    lid = side(0.2)[:400] * (0.6, 0.6, 1.0)
    beside = side(0.0)[:400] + np.array([0.08, 0.0, 0.0])
    points = np.concatenate([side(0.2), lid, beside])
    assert widening(points) == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize(("category", "resting", "points", "turned"), [
    ("can", "lying", side(0.2), True), ("can", "upside-down", side(0.2), True),
    ("can", "lying", side(0.14), False), ("can", "lying", side(-0.2), False),
    ("can", "upright", side(0.15), True), ("can", "upright", side(0.1), False),
    ("bottle", "lying", side(-0.25), True), ("bottle", "upright", side(-0.25), False),
    ("bottle", "lying", side(0.25), False), ("bottle", "lying", side(-0.25, bulge=-1.0), False),
    ("bottle", "lying", side(-0.25) * np.where(side(-0.25)[:, 2:] > 0.04, (0.5, 0.5, 1.0), 1.0), False),
    ("bottle", "lying", side(-0.25)[side(-0.25)[:, 2] < 0.039], False),
    ("mug", "lying", side(0.25), False),
], ids=["can", "standing-can", "nearly-straight", "right-can", "standing-cone", "standing-straight",
        "closed-cup", "upright", "right-cup", "barrel",
        "neck", "end-unseen", "mug"])  # fmt: skip
def test_what_has_its_lower_end_up_is_turned_over(category, resting, points, turned) -> None:
    """In the frame of the estimate, wherever that is: here on its side, seen from above."""
    T = np.array([[0, 0, 1, 0.4], [0, 1, 0, -0.1], [-1, 0, 0, 0.03], [0, 0, 0, 1.0]])
    points = (points @ T[:3, :3].T + T[:3, 3])[points[:, 0] < 0.01]
    mesh = TriangleMesh(cylinder(), np.array([[0, 1, 60]]))
    estimate = ObjectEstimate(0, category, np.zeros(16), T, np.ones(3), mesh, resting=resting)
    assert is_turned_over(estimate, (seen_from_above(points),)) == turned


@pytest.mark.parametrize(("slope", "turned"), [(0.25, True), (0.16, False)])
def test_what_may_be_a_bottle_has_to_widen_more(slope, turned) -> None:
    T = np.eye(4)
    mesh = TriangleMesh(cylinder(), np.array([[0, 1, 60]]))
    can = ObjectEstimate(0, "can", np.zeros(16), T, np.ones(3), mesh)
    views = (seen_from_above(side(slope)),)
    assert is_turned_over(can, views)
    assert is_turned_over(can, views, is_doubtful=True) == turned


def seen_from_above(points: np.ndarray) -> ObjectObservation:
    """An image in which every pixel is one of the points."""
    camera = CameraIntrinsics(len(points), 1, 1.0, 1.0, 0.0, 0.0)

    class Cloud(ObjectObservation):
        def points_world(self, erode: int) -> np.ndarray:
            return points

    blank = np.zeros((1, len(points)), np.float32)
    frame = RgbdFrame(0.0, np.zeros((1, len(points), 3), np.uint8), blank, camera, np.eye(4))
    return Cloud(frame, np.ones((1, len(points)), bool))


def test_a_can_that_is_turned_over_keeps_its_surface() -> None:
    T = np.array([[0, -1, 0, 0.4], [1, 0, 0, -0.1], [0, 0, 1, 0.05], [0, 0, 0, 1.0]])
    sigma = np.linspace(0.001, 0.002, len(cylinder()))
    mesh = TriangleMesh(cylinder() * (1.0, 1.0, 1.1), np.array([[0, 1, 60]]))
    first = ObjectEstimate(3, "can", np.zeros(16), T, np.ones(3), mesh, 0.8, surface_sigma=sigma)
    other = ObjectEstimate(3, "can", np.ones(16), np.eye(4), 2 * np.ones(3), mesh, 0.1, resting="upside-down")
    turned = turned_over(first, other)
    np.testing.assert_allclose(turned.mesh_world.vertices, first.mesh_world.vertices)
    np.testing.assert_allclose(turned.T_world_object[:3, 2], (0, 0, -1))
    assert turned.score == 0.8 and turned.resting == "upside-down" and turned.surface_sigma is not None
    np.testing.assert_array_equal(turned.code, other.code)
