"""Distractors: which kinds each split shows."""

from collections import Counter

import numpy as np
import pytest

from sim_assets.datasets import distractors


def draw_kinds(monkeypatch, split, count=300):
    """Return how often each kind is drawn."""
    drawn = Counter()

    def spy(kind):
        def draw(rng):
            drawn[kind.__name__] += 1
            return kind(rng)

        return draw

    for name in ("_KINDS", "_HELD_OUT"):
        monkeypatch.setattr(distractors, name, tuple(map(spy, getattr(distractors, name))))
    rng = np.random.default_rng(0)
    for _ in range(count):
        distractors.random_distractor(rng, split)
    return drawn


HELD_OUT = {"letter", "bench", "spoon"}
N_KINDS = len(set(distractors._KINDS))  # more probable kinds are listed repeatedly


def test_two_in_five_distractors_of_the_test_split_are_of_held_out_kinds(monkeypatch):
    drawn = draw_kinds(monkeypatch, "test")
    assert drawn.keys() >= HELD_OUT and len(drawn) == N_KINDS + len(HELD_OUT)
    assert sum(drawn[kind] for kind in HELD_OUT) == pytest.approx(0.4 * 300, abs=30)


def test_the_training_split_never_shows_held_out_kinds(monkeypatch):
    drawn = draw_kinds(monkeypatch, "train")
    assert not drawn.keys() & HELD_OUT and len(drawn) == N_KINDS
