"""Objects of a task: counts, split, and bowls of different size."""

from collections import Counter

import numpy as np
import pytest
from trimesh import creation

from sim_assets.objects import ObjectModel, sampling
from sim_assets.objects.mesh_shape import MeshShape
from sim_assets.objects.sampling import NESTING_STEP, draw_objects, nestable


def cylinder(radius, category="bowl", split="test"):
    mesh = creation.cylinder(radius=radius, height=0.05, sections=4)  # corners on x and y
    return ObjectModel(category, split, category, mesh, (), 0.1, None, MeshShape(mesh, category))


def test_counts_and_split_are_as_asked(monkeypatch):
    monkeypatch.setattr(
        sampling, "sample_object", lambda c, split, rng: cylinder(float(rng.uniform(0.045, 0.09)), c, split)
    )
    for split in ("train", "test"):
        drawn = draw_objects({"mug": 2, "bowl": 3, "can": 1}, split, np.random.default_rng(0))
        assert Counter(o.category for o in drawn) == {"mug": 2, "bowl": 3, "can": 1}
        assert {o.split for o in drawn} == {split}
        radii = np.sort([o.radius for o in drawn if o.category == "bowl"])
        assert np.diff(radii).min() >= NESTING_STEP == 0.012


def test_order_is_random(monkeypatch):
    monkeypatch.setattr(sampling, "sample_object", lambda c, split, rng: cylinder(0.05, c, split))
    orders = {
        tuple(o.category for o in draw_objects({"mug": 2, "can": 2}, "test", np.random.default_rng(seed)))
        for seed in range(8)
    }
    assert len(orders) > 2


def test_without_a_different_bowl_the_most_different_one_is_taken():
    radii = iter([0.05] + [0.051, 0.055, 0.052] * 40)
    bowls = nestable(lambda: cylinder(next(radii)), 2)
    assert [bowl.radius for bowl in bowls] == pytest.approx([0.05, 0.055])
