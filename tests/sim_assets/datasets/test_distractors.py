"""Distractors: the held-out kinds appear in the test split alone."""

import numpy as np
import pytest
import trimesh

from sim_assets.datasets import distractors
from sim_assets.datasets.distractors import random_distractor, random_parts


@pytest.fixture
def drawn(monkeypatch):
    """Names of the kinds drawn, instead of their meshes' cost."""
    names = []

    def marked(kind):
        def make(rng):
            names.append(kind.__name__)
            return trimesh.creation.box((0.1, 0.1, 0.1))

        return make

    for group in ("_KINDS", "_HELD_OUT"):
        monkeypatch.setattr(distractors, group, tuple(map(marked, getattr(distractors, group))))
    return names


HELD_OUT = {"letter", "bench", "spoon"}


def test_training_never_shows_held_out_kinds(drawn):
    rng = np.random.default_rng(0)
    for _ in range(400):
        random_distractor(rng, "train")
    assert not HELD_OUT & set(drawn) and len(set(drawn)) > 10


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


@pytest.mark.parametrize("kind", [*dict.fromkeys(distractors._KINDS), *distractors._HELD_OUT, random_parts])
def test_every_kind_is_a_finite_mesh_of_a_size_for_tables(kind):
    rng = np.random.default_rng(3)
    for _ in range(5):
        extents = kind(rng).extents
        assert np.isfinite(extents).all() and extents.min() > 0.002 and extents.max() < 0.45
