"""Bottles: profiles in closed form, tops, sections, and the parameters of the splits."""

from dataclasses import replace

import numpy as np
import pytest

from sim_assets.objects.bottle import (
    KINDS,
    WIDEST_GRIP,
    BottleParameters,
    bottle_profile,
    bottle_solid,
    sample_bottle,
)
from sim_assets.objects.profiles import radial_crossings

ROUND = BottleParameters(
    kind="round", radius=0.04, height=0.2, bend=0.0, body_top=0.12, neck_bottom=0.15, cap_bottom=0.18,
    shoulder="cone", neck_radius=0.015, cap_radius=0.018, top="screw", base_fillet=0.005,
    aspect=1.0, exponent=2.0, density=500.0,
)  # fmt: skip


def radius_at(parameters, *heights):
    return radial_crossings(bottle_profile(parameters), np.array(heights))[:, 0]


def test_body_shoulder_neck_and_cap_of_a_round_bottle():
    np.testing.assert_allclose(radius_at(ROUND, 0.03, 0.06, 0.115), 0.04)
    np.testing.assert_allclose(radius_at(ROUND, 0.165), 0.015)
    np.testing.assert_allclose(radius_at(ROUND, 0.19), 0.018 * (1 + 0.985) / 2, atol=2e-4)
    assert bottle_profile(ROUND)[:, 1].max() == 0.2 and bottle_profile(ROUND)[:, 1].min() == 0.0


@pytest.mark.parametrize(("shoulder", "share"), [("round", np.sqrt(0.75)), ("cone", 0.5), ("ogee", 0.5)])
def test_shoulder_falls_from_body_to_neck(shoulder, share):
    """Half-way up: sqrt(1 - u²), 1 - u and 1 - smoothstep(u) at u = 1/2."""
    parameters = replace(ROUND, shoulder=shoulder)
    assert radius_at(parameters, 0.135)[0] == pytest.approx(0.015 + 0.025 * share, abs=2e-4)
    quarter = {"round": np.sqrt(1 - 1 / 16), "cone": 0.75, "ogee": 1 - 5 / 32}[shoulder]
    assert radius_at(parameters, 0.1275)[0] == pytest.approx(0.015 + 0.025 * quarter, abs=2e-4)


@pytest.mark.parametrize(
    ("kind", "low", "middle", "high"),
    [
        ("rectangular", 1.0, 1.0, 1.0),
        ("tapered", 0.75, 0.875, 1.0),  # 1 - k (1 - u) at u = 0.25, 0.5, 1 less the soft edge
        ("bulged", 1 - 0.2 * 0.25, 1.0, 1 - 0.2 * 0.25),
        ("squeeze", 1 - 0.2 * 0.25, 1.0, 1 - 0.2 * 0.25),
        ("waisted", 1 - 0.2 * 0.75**2, 0.8, 1 - 0.2 * 0.75**2),
        ("oval", 1 - 0.2 * 0.75**2, 0.8, 1 - 0.2 * 0.75**2),
    ],
)
def test_side_of_the_body(kind, low, middle, high):
    bend = 0.25 if kind == "tapered" else 0.2
    parameters = replace(ROUND, kind=kind, bend=bend, base_fillet=0.0)
    heights = (0.03, 0.06, 0.09)
    expected = np.array([low, middle, high])
    if kind == "tapered":
        expected = 1 - bend * (1 - np.array([0.25, 0.5, 0.75]))
    np.testing.assert_allclose(radius_at(parameters, *heights), 0.04 * expected, atol=1e-4)


def test_base_fillet_is_a_quarter_circle():
    """f - sqrt(f² - (f - z)²) at heights of the profile's points, an edge of 3.75 mm apart."""
    f, z = 0.01, np.array([0.00375, 0.0075])
    expected = 0.04 - (f - np.sqrt(f**2 - (f - z) ** 2))
    np.testing.assert_allclose(radius_at(replace(ROUND, base_fillet=f), *z), expected, atol=4e-4)
    assert radius_at(replace(ROUND, base_fillet=0.0), 0.003)[0] == pytest.approx(0.04, abs=1e-6)


@pytest.mark.parametrize(("top", "share"), [("screw", 0.985), ("lid", 0.985), ("flip", 0.38), ("dome", 0.38)])
def test_top_narrows_to_its_share_of_the_cap(top, share):
    profile = bottle_profile(replace(ROUND, top=top))
    widest_on_top = profile[profile[:, 1] > 0.2 - 1e-9, 0].max()
    assert widest_on_top == pytest.approx(share * 0.018, abs=2.2e-3) and profile[:, 1].max() == 0.2
    assert profile[profile[:, 1] > 0.18, 0].max() <= 0.018


def test_flat_bottles_have_their_aspect_below_and_a_round_neck():
    solid = bottle_solid(replace(ROUND, aspect=0.6, exponent=4.0))
    np.testing.assert_allclose(solid.bounds, [(-0.04, -0.024, 0), (0.04, 0.024, 0.2)], atol=5e-4)
    points = np.array([(0, 0.023, 0.06), (0, 0.025, 0.06), (0.039, 0, 0.06), (0, 0.0145, 0.165)])
    np.testing.assert_array_equal(solid.inside(points), [True, False, True, True])
    assert bottle_solid(ROUND).body.section is None


@pytest.mark.parametrize("split", ["train", "test"])
def test_sampled_bottles_can_be_held_and_weigh_what_bottles_do(split):
    rng = np.random.default_rng(0)
    for p in (sample_bottle(split, rng) for _ in range(150)):
        assert p.kind in KINDS[split]
        assert 2 * p.cap_radius <= WIDEST_GRIP == 0.070
        assert 150 <= p.density <= 700
        assert 0 < p.body_top < p.neck_bottom < p.cap_bottom < p.height
        flat = p.kind in ("rectangular", "squeeze", "oval")
        assert 0.55 <= p.aspect < 1 if flat else p.aspect == 1 and p.exponent == 2
        tops = {"tumbler": {"lid"}, "shaker": {"dome"}, "squeeze": {"flip"}, "oval": {"flip", "screw"}}
        assert p.top in tops.get(p.kind, {"screw"})
        assert p.height - p.neck_bottom >= 0.026 - 1e-9 or p.kind in ("tumbler", "shaker")  # for the fingers
