"""Training grids: one sequence for a seed, and the shares of free forms in the training split alone."""

import numpy as np
import pytest

from perception.types import CATEGORIES
from sim_assets.objects import SPLITS, sample_parameters, sample_training_grids
from sim_assets.objects.training_grids import FREE, sample_training_shape

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


def test_free_forms_have_their_share_of_the_training_shapes_and_no_test_shape_has_one():
    rng = np.random.default_rng(5)
    free = np.mean([bool(sample_training_shape("can", "train", rng).radii) for _ in range(600)])
    assert free == pytest.approx(FREE["can"], abs=0.07)
    for category in CATEGORIES:
        shapes = [sample_training_shape(category, "test", np.random.default_rng(k)) for k in range(20)]
        assert shapes == [sample_parameters(category, "test", np.random.default_rng(k)) for k in range(20)]


def test_the_model_card_tells_the_shares():
    from app.training.shape import _FAMILIES

    text = " ".join(_FAMILIES.split())
    assert f"Of the cans {100 * FREE['can']:.0f} %, of the bottles {100 * FREE['bottle']:.0f} %" in text
