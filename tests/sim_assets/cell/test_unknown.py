"""Things of no class as bodies: size, pieces, mass."""

import numpy as np
import pytest
import trimesh

from sim_assets.cell.unknown import HEAVIEST, LIGHTEST, LONGEST, TALLEST, as_body, draw_unknown


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


def test_the_hulls_hold_what_is_hollow_in_the_mesh():
    ring = trimesh.creation.annulus(0.04, 0.05, 0.02)
    body = as_body(ring)
    assert body.hulls.volume > 1.5 * ring.volume
    assert body.hulls.bounds == pytest.approx(ring.bounds)
