"""Rims and contents of vessels in closed form: points of a paraboloid bowl, a liquid, a heap."""

import numpy as np
import pytest

from perception.inference.contents import Rim, content_mask, find_rim, without_contents
from perception.inference.initialise import plane_basis
from perception.types import SupportPlane

CENTRE, RADIUS, HEIGHT = np.array([0.4, -0.1]), 0.08, 0.07
RIM = Rim(CENTRE, RADIUS, HEIGHT)
EYE, EYE_HEIGHT = np.array([0.0, -0.1]), 0.45


def disc(radius: float = 0.97 * RADIUS, n: int = 4000) -> np.ndarray:
    """Offsets from the centre, uniform over a disc, in metres."""
    rng = np.random.default_rng(0)
    r, a = radius * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    return np.stack([r * np.cos(a), r * np.sin(a)], axis=1)


def visible(offset: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Which points of the cavity the camera sees through the rim."""
    share = (EYE_HEIGHT - HEIGHT) / (EYE_HEIGHT - height)
    crossing = EYE + (CENTRE + offset - EYE) * share[:, None]
    return np.linalg.norm(crossing - CENTRE, axis=1) < RADIUS


def contents_of(height: np.ndarray, offset: np.ndarray, category="bowl") -> np.ndarray:
    seen = visible(offset, height)
    return content_mask(CENTRE + offset[seen], height[seen], EYE, EYE_HEIGHT, RIM, category)


def bowl(offset: np.ndarray) -> np.ndarray:
    return 0.008 + (HEIGHT - 0.008) * (np.linalg.norm(offset, axis=1) / RADIUS) ** 2


def test_an_empty_bowl_and_an_empty_mug_have_no_contents() -> None:
    offset = disc()
    assert not contents_of(bowl(offset), offset).any()
    assert not contents_of(np.full(len(offset), 0.006), offset, "mug").any()  # its floor


@pytest.mark.parametrize("heap", [0.0, 0.012])
def test_contents_are_found_and_the_wall_above_them_is_kept(heap) -> None:
    offset = disc()
    wall, rho = bowl(offset), np.linalg.norm(offset, axis=1) / RADIUS
    level = 0.045 + heap * (1 - rho**2)
    height = np.maximum(wall, level)
    seen = visible(offset, height)
    found = contents_of(height, offset)
    on_contents = (level > wall)[seen]
    assert found[on_contents].mean() > 0.93
    high_wall = ~on_contents & (height[seen] > 0.045 + heap + 0.006)
    assert high_wall.sum() > 50 and not found[high_wall].any()


@pytest.mark.parametrize("peak", [0.0, 0.03])
def test_a_heap_up_to_the_rim_and_above_it_is_found_whole(peak) -> None:
    """The middle of nearly full contents is as high as the rim, and yet no part of the vessel."""
    offset = disc()
    wall, rho = bowl(offset), np.linalg.norm(offset, axis=1) / RADIUS
    height = np.maximum(wall, 0.055 + (0.015 + peak) * (1 - rho**2))
    seen = visible(offset, height) | (height > HEIGHT)
    found = content_mask(CENTRE + offset[seen], height[seen], EYE, EYE_HEIGHT, RIM, "bowl")
    assert found[rho[seen] < 0.7].all()


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.01, 0.015)])
def test_a_thing_in_an_empty_bowl_is_found_and_the_bowl_around_it_is_kept(place) -> None:
    offset = disc()
    thing = np.linalg.norm(offset - place, axis=1) < 0.02
    height = np.where(thing, HEIGHT, bowl(offset))
    seen = visible(offset, height)
    found = contents_of(height, offset)
    assert found[thing[seen]].all()
    assert found[~thing[seen]].mean() < 0.01


def test_the_rim_below_a_heap() -> None:
    offset = disc(RADIUS)
    rho = np.linalg.norm(offset, axis=1) / RADIUS
    height = np.where(rho < 0.7, HEIGHT + 0.04 * (1 - (rho / 0.7) ** 2), bowl(offset))
    found = find_rim(CENTRE + offset, height)
    assert found is not None
    assert found.radius == pytest.approx(RADIUS, abs=0.003)
    assert found.height == pytest.approx(HEIGHT, abs=0.005)


def test_things_beside_a_vessel_in_its_mask_are_no_outline() -> None:
    """Where a mask is too large, it shows the table and low things: the rim is still the highest ring."""
    rng = np.random.default_rng(2)
    angle = rng.uniform(0, 2 * np.pi, 900)
    rim = CENTRE + RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    around = CENTRE + 2.5 * disc(RADIUS, 3000)
    height = np.concatenate([np.full(900, HEIGHT), rng.uniform(0, 0.3 * HEIGHT, 3000)])
    found = find_rim(np.concatenate([rim, around]), height)
    assert found is not None
    assert found.radius == pytest.approx(RADIUS, abs=0.002)
    assert found.height == pytest.approx(HEIGHT, abs=0.002)


def test_a_camera_below_the_rim_sees_no_contents() -> None:
    offset = disc()
    height = np.full(len(offset), 0.05)
    assert not content_mask(CENTRE + offset, height, EYE, 0.06, RIM, "bowl").any()


def test_the_rim_is_found_beside_handles_and_full_contents() -> None:
    rng = np.random.default_rng(1)
    angle = rng.uniform(0, 2 * np.pi, 600)
    rim = CENTRE + RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    heap, handle = CENTRE + disc(0.6 * RADIUS, 900), CENTRE + [RADIUS + 0.02, 0.0] + 0.004 * disc(1.0, 60)
    plan = np.concatenate([rim, heap, handle])
    height = np.concatenate([
        np.full(600, HEIGHT), np.full(900, HEIGHT - 0.003), np.full(60, HEIGHT - 0.002)
    ]) + rng.normal(0, 0.0005, 1560)  # fmt: skip
    found = find_rim(plan, height)
    assert found is not None
    np.testing.assert_allclose(found.centre, CENTRE, atol=0.002)
    assert found.radius == pytest.approx(RADIUS, abs=0.002)
    assert found.height == pytest.approx(HEIGHT, abs=0.002)


def test_no_rim_without_points_all_around() -> None:
    angle = np.linspace(0, 0.9 * np.pi, 500)
    arc = CENTRE + RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert find_rim(arc, np.full(500, HEIGHT)) is None
    assert find_rim(arc[:10], np.full(10, HEIGHT)) is None


def test_solid_things_are_left_as_they_are(can) -> None:
    """The flat top of a can is at the height of its rim: nothing lies below it."""
    plane = SupportPlane()
    seen = can.observations((0.0, 2.0))
    same = without_contents(seen, "mug", plane, plane_basis(plane))
    assert all(after is before for after, before in zip(same, seen))
