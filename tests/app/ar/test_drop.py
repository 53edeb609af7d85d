import numpy as np
import pytest

from app.ar.drop import BALL, DROP_HEIGHT, EVERY, FIRST, LEAST_BALL, SNUG, plan_drops, rim_radius
from sim_assets.objects.convex.perceived_mesh import PolarBody

UP = np.array([0.0, 0.0, 1.0])


def body(opening, height=0.1):
    """A cylinder of radius 40 mm, with a cavity from a quarter of its height upwards if it has an opening."""
    z = np.linspace(0.0, height, 9)
    inner = np.zeros((9, 4))
    inner[2:] = opening
    floor = 2 if opening else 8
    return PolarBody(np.zeros(2), z, inner, np.full((9, 4), 0.04), 0, floor)


def drops(standing, bodies, count, seed=0):
    objects = [standing("can", i, (0.2 * i, -0.3)) for i in range(len(bodies))]
    return objects, plan_drops(objects, bodies, UP, count, np.random.default_rng(seed))


def test_rim_radius():
    assert rim_radius(body(0.03)) == pytest.approx(0.03)
    assert rim_radius(body(0.0)) == 0.0


@pytest.mark.parametrize(
    ("opening", "size"), [(0.035, BALL), (0.02, SNUG * 0.02), (0.005, LEAST_BALL), (0.0, BALL)]
)
def test_a_ball_above_each_object_fits_its_opening(standing, opening, size):
    (target,), (toy,) = drops(standing, [body(opening)], 1)
    assert toy.kind == "ball" and toy.size == pytest.approx(size)
    local = toy.position - target.T_world_object[:3, 3]
    assert local[2] == pytest.approx(0.1 + DROP_HEIGHT + size)
    aside = 0.25 * opening if opening else 0.3 * 0.04
    assert np.hypot(*local[:2]) == pytest.approx(aside)


def test_toys_are_released_one_after_another_objects_first(standing):
    objects, toys = drops(standing, [body(0.03), body(0.0)], 7)
    np.testing.assert_allclose([toy.release for toy in toys], FIRST + EVERY * np.arange(7))
    first = sorted(toy.position[0] for toy in toys[:2])
    assert first[0] == pytest.approx(0.0, abs=0.02) and first[1] == pytest.approx(0.2, abs=0.02)
    tallest = max(o.mesh_world.vertices[:, 2].max() for o in objects)
    for toy in toys[2:]:
        assert toy.position[2] == pytest.approx(tallest + DROP_HEIGHT)
        assert 0.6 * BALL <= toy.size <= 1.1 * BALL
    assert [toy.kind for toy in toys[2:]] == ["ball", "die", "ball", "pill", "ball"]
    assert len({toy.color for toy in toys}) == 7


def test_fewer_toys_than_objects(standing):
    assert len(drops(standing, [body(0.03)] * 3, 2)[1]) == 2


def test_one_seed_makes_one_plan(standing):
    (_, a), (_, b), (_, c) = (drops(standing, [body(0.03)], 4, seed) for seed in (1, 1, 2))
    assert all(np.array_equal(x.position, y.position) for x, y in zip(a, b))
    assert not np.array_equal(a[1].position, c[1].position)
