"""Things of no class as bodies: size, pieces, mass."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from perception.obstacles.obstacle import is_within
from sim_assets.cell.unknown import HEAVIEST, LIGHTEST, LONGEST, MOST_PIECES, TALLEST, as_body, draw_unknown
from sim_assets.datasets.distractors import basic, held_out
from sim_assets.datasets.distractors.shapes import standing


def test_things_fit_the_table_and_differ():
    things = draw_unknown(6, np.random.default_rng(0))
    assert len({len(thing.mesh.vertices) for thing in things}) > 2
    for thing in things:
        x, y, z = thing.mesh.extents
        assert max(x, y) <= LONGEST and z <= TALLEST
        assert LIGHTEST <= thing.mass <= HEAVIEST


def test_each_part_is_a_convex_piece():
    far = trimesh.creation.box((0.1, 0.1, 0.1))
    far.apply_translation((0.3, 0, 0))
    body = as_body(trimesh.util.concatenate([trimesh.creation.box((0.1, 0.1, 0.1)), far]))
    assert sorted(piece.vertices[:, 0].mean() for piece in body.collision) == pytest.approx([0.0, 0.3])
    assert body.mass == pytest.approx(2 * 0.001 * 400)


def test_a_ring_is_open_for_what_touches_and_as_heavy_as_a_disc():
    ring = trimesh.creation.annulus(0.04, 0.05, 0.02)
    body = as_body(ring)
    assert body.hulls.volume == pytest.approx(ring.volume, rel=0.2)
    assert body.hulls.bounds == pytest.approx(ring.bounds, abs=1e-6)
    assert body.mass == pytest.approx(400 * ring.convex_hull.volume)


@pytest.mark.parametrize(
    "kind", [*held_out.KINDS, basic.candlestick, basic.plate], ids=lambda kind: kind.__name__
)
def test_nothing_touches_far_from_what_is_seen(kind):
    mesh = standing(kind(np.random.default_rng(1)))
    body = as_body(mesh)
    assert len(body.collision) <= MOST_PIECES
    seen = KDTree(mesh.sample(20_000, seed=0))
    for piece in body.collision:
        points = trimesh.convex.convex_hull(piece.vertices).sample(300, seed=0)
        away = seen.query(points)[0]
        for other in body.collision:
            if other is not piece:  # the faces of a cut are inside the thing
                away[is_within(points, other.vertices, 3e-4)] = 0.0
        assert away.max() < 0.009


def test_the_pieces_of_an_intricate_thing_are_limited():
    comb = [trimesh.creation.torus(0.02, 0.003) for _ in range(6)]
    for index, ring in enumerate(comb):
        ring.apply_translation((0.06 * index, 0, 0))
    body = as_body(trimesh.util.concatenate(comb))
    assert 6 <= len(body.collision) <= MOST_PIECES
