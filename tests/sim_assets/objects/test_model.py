"""Object models: mass from volume and density, sizes from bounds, classes from parameters."""

from dataclasses import replace

import numpy as np
import pytest

from perception.types import CATEGORIES
from sim_assets.objects import make_object, sample_object, sample_parameters
from sim_assets.objects.model import HEAVIEST, LIGHTEST, category_of


def test_mass_is_volume_times_density_within_what_the_gripper_carries():
    parameters = replace(sample_parameters("can", "train", np.random.default_rng(1)), density=600.0)
    model = make_object(parameters, "train")
    assert (LIGHTEST, HEAVIEST) == (0.05, 0.6)
    assert model.mass == pytest.approx(np.clip(600.0 * model.mesh.volume, 0.05, 0.6))
    assert make_object(replace(parameters, density=1e5), "train").mass == HEAVIEST
    assert make_object(replace(parameters, density=1e-3), "train").mass == LIGHTEST


@pytest.mark.parametrize("category", CATEGORIES)
def test_sampled_object_keeps_class_and_split(category):
    model = sample_object(category, "test", np.random.default_rng(0))
    assert model.category == category == category_of(model.parameters) and model.split == "test"
    assert model.height == pytest.approx(np.ptp(model.mesh.bounds[:, 2]), abs=1e-6)
    assert model.radius == pytest.approx(np.ptp(model.mesh.bounds[:, 1]) / 2, rel=0.01)
