"""Sampling of rays about an object."""

import pytest

from perception.inference.observation import ray_samples, sampling_radius


def test_sampling_radius_adds_a_margin_of_15_mm():
    assert sampling_radius(0.05) == pytest.approx(0.065)


@pytest.mark.parametrize(("step", "count"), [(0.005, 40), (0.0051, 39), (0.1, 24), (1e-4, 192)])
def test_ray_samples_cover_the_depth_range_within_bounds(step, count):
    assert ray_samples(0.1, step) == count
