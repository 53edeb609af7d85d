"""Every kind: a finite mesh of its size, outward surfaces, few triangles, textured, repeatable."""

import numpy as np
import pytest

from sim_assets.datasets.distractors import cartons


@pytest.mark.parametrize("kind", dict.fromkeys(cartons.KINDS))
def test_kind(kind, check_kind):
    check_kind(kind, largest=0.5)


def test_cartons_have_the_sizes_of_cartons_in_shops():
    sizes = np.array([cartons.carton_size(np.random.default_rng(seed)) for seed in range(300)])
    cereal = (np.abs(sizes - (0.065, 0.19, 0.29)) < (0.02, 0.04, 0.03)).all(axis=1)
    crackers = (np.abs(sizes - (0.06, 0.16, 0.22)) < (0.02, 0.04, 0.03)).all(axis=1)
    assert cereal.any() and crackers.any() and sizes.max() < 0.33 and sizes.min() > 0.029


def test_a_leaning_carton_touches_ground_and_neighbour():
    for seed in range(20):
        mesh = cartons.leaning_cartons(np.random.default_rng(seed))
        first, leaning = mesh.vertices[:8], mesh.vertices[8:]
        assert first[:, 2].min() == pytest.approx(0) and leaning[:, 2].min() == pytest.approx(0, abs=1e-9)
        top = leaning[np.abs(leaning[:, 0] - leaning[:, 0].min()) < 1e-9]
        if top[0, 2] <= first[:, 2].max():  # it touches with its upper edge
            assert top[0, 0] == pytest.approx(first[:, 0].max(), abs=1e-6)


def test_prints_turn_with_their_carton():
    mesh = cartons.lying_carton(np.random.default_rng(0))
    assert mesh.metadata["surfaces"] == ("print",) * 3
