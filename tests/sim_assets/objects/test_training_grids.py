"""Training grids: one sequence for a seed, and the shares of free forms in the training split alone."""

import numpy as np
import pytest

from perception.types import CATEGORIES
from sim_assets.objects import SPLITS, sample_parameters, sample_training_grids
from sim_assets.objects.training_grids import FREE, HOUSEHOLD, sample_training_shape

EVERY = [(category, split) for category in CATEGORIES for split in SPLITS]


@pytest.mark.parametrize(("category", "split"), EVERY)
def test_same_seed_same_grids(category, split):
    grids = [sample_training_grids(category, 2, seed=3, split=split) for _ in range(2)]
    assert grids[0].dtype == np.uint8 and grids[0].max() == 255
    np.testing.assert_array_equal(*grids)
    assert (grids[0] != sample_training_grids(category, 2, seed=4, split=split)).any()


@pytest.mark.parametrize(("category", "split"), EVERY)
def test_a_later_part_of_the_sequence_is_that_of_the_whole(category, split):
    whole = sample_training_grids(category, 4, seed=3, split=split)
    np.testing.assert_array_equal(sample_training_grids(category, 2, 3, split, first=2), whole[2:])


def test_free_forms_and_sizes_of_homes_have_their_share_and_no_test_shape_has_one():
    rng = np.random.default_rng(5)
    cans = [sample_training_shape("can", "train", rng) for _ in range(600)]
    assert np.mean([bool(can.radii) for can in cans]) == pytest.approx(FREE["can"], abs=0.07)
    unusual = [not 0.9 <= can.height / (2 * can.radius) <= 2.9 for can in cans]
    assert 0.2 < np.mean(unusual) < HOUSEHOLD["can"], "flat tins and tubes"
    for category in CATEGORIES:
        shapes = [sample_training_shape(category, "test", np.random.default_rng(k)) for k in range(20)]
        assert shapes == [sample_parameters(category, "test", np.random.default_rng(k)) for k in range(20)]
