"""Draws: held-out kinds appear in the test split alone; everything rests on z = 0 in its size."""

import numpy as np
import pytest
import trimesh

from sim_assets.datasets.distractors import draw, held_out
from sim_assets.datasets.distractors.draw import LARGEST, random_distractor, random_surrounding
from sim_assets.rendering.texture_coordinates import ATTRIBUTE

HELD_OUT = {kind.__name__ for kind in held_out.KINDS}
TRAINED = {kind.__name__ for _, kinds in draw._GROUPS for kind in kinds}


@pytest.fixture
def drawn(monkeypatch):
    """Names of the kinds drawn, instead of their meshes' cost."""
    names = []

    def marked(kind):
        def make(rng):
            names.append(kind.__name__)
            return trimesh.creation.box((0.1, 0.1, 0.1))

        return make

    groups = tuple((share, tuple(map(marked, kinds))) for share, kinds in draw._GROUPS)
    monkeypatch.setattr(draw, "_GROUPS", groups)
    monkeypatch.setattr(draw, "_HELD_OUT", tuple(map(marked, draw._HELD_OUT)))
    return names


def test_no_kind_is_both_trained_and_held_out():
    assert not HELD_OUT & TRAINED and {"letter", "bench", "spoon"} < HELD_OUT
    assert len(HELD_OUT) >= 10 and len(TRAINED) >= 50


def test_training_never_shows_held_out_kinds(drawn):
    rng = np.random.default_rng(0)
    for _ in range(1500):
        random_distractor(rng, "train")
    assert set(drawn) == TRAINED


def test_two_fifths_of_the_test_split_are_held_out_kinds(drawn):
    rng = np.random.default_rng(0)
    for _ in range(1000):
        random_distractor(rng, "test")
    share = np.mean([name in HELD_OUT for name in drawn])
    assert set(drawn) >= HELD_OUT and share == pytest.approx(0.4, abs=0.05)


def test_training_is_the_default_split(drawn):
    rng = np.random.default_rng(1)
    for _ in range(100):
        random_distractor(rng)
    assert not HELD_OUT & set(drawn)


def test_a_third_are_packages(drawn):
    rng = np.random.default_rng(2)
    for _ in range(1000):
        random_distractor(rng)
    packages = {kind.__name__ for kind in draw.cartons.KINDS}
    assert np.mean([name in packages for name in drawn]) == pytest.approx(0.34, abs=0.05)


@pytest.mark.parametrize("split", ["train", "test"])
def test_distractors_rest_on_the_table_within_their_largest_size(split):
    rng = np.random.default_rng(3)
    tall = 0
    for _ in range(120):
        mesh = random_distractor(rng, split)
        assert mesh.bounds[0, 2] == pytest.approx(0, abs=1e-9)
        np.testing.assert_allclose(mesh.bounds[:, :2].mean(axis=0), 0, atol=1e-9)
        assert mesh.extents.min() > 0.002 and mesh.extents.max() <= LARGEST + 1e-9
        assert mesh.metadata["surfaces"] and mesh.face_attributes[ATTRIBUTE].shape == (len(mesh.faces), 3, 2)
        tall += mesh.extents[2] > 0.16
    assert tall > 20  # taller than any parcel: real cartons are 0.16 to 0.32 m high


def test_surroundings_are_big_and_rest_on_the_floor():
    rng = np.random.default_rng(4)
    for _ in range(60):
        mesh = random_surrounding(rng)
        assert mesh.bounds[0, 2] == pytest.approx(0, abs=1e-9)
        assert 0.3 < mesh.extents.max() < 1.7


def test_same_seed_same_mesh():
    for make in (random_distractor, random_surrounding):
        first, again, other = (make(np.random.default_rng(seed)) for seed in (5, 5, 6))
        np.testing.assert_array_equal(first.vertices, again.vertices)
        assert first.vertices.shape != other.vertices.shape or (first.vertices != other.vertices).any()
