"""Training patches: votes that meet at the feet, pixels that are not judged, colours."""

from dataclasses import replace

import numpy as np
import pytest

from perception.detection.scene_patches import UNJUDGED, LabelledScene, sample_patch, vary_colours
from perception.detection.working_view import CHANNELS
from perception.types import SupportPlane

PLACES = [(0.42, -0.25), (0.55, -0.18)]


@pytest.fixture(scope="module")
def picture(scenes):
    solids = [scenes.Solid(x, y, 0.1, radius=0.035) for x, y in PLACES]
    scene = scenes.render(solids, scenes.orbit((0.48, -0.22, 0.05), 0.5, 50, 70))
    feet = np.column_stack([PLACES, np.zeros(len(PLACES))])
    things, label = (scene.instances + 1).astype(np.uint8), np.array([2, 4])
    return LabelledScene(scene.frame, things, label, feet, SupportPlane(np.array([0.0, 0.0, 1.0]), 0.0))


def test_offsets_lead_to_the_feet_mirrored_or_not(picture):
    """Where things stand in the picture's own axes: what all pixels of one thing vote for is one place."""
    for seed in range(6):
        sample = sample_patch(picture, 192, np.random.default_rng(seed))
        assert sample.channels.shape == (192, 192, CHANNELS) and sample.label.shape == (96, 96)
        assert set(np.unique(sample.label)) <= {-1, 2, 4}
        inside = sample.weight > 0
        assert np.array_equal(inside, sample.things[::2, ::2] > 0)
        step = np.diff(sample.offset[..., 0], axis=1)[inside[:, 1:] & inside[:, :-1]]
        assert np.median(step) == pytest.approx(-2, abs=0.5)  # two pixels nearer, two pixels less to go


def test_unjudged_pixels_have_neither_class_nor_vote(picture):
    around = np.where(picture.things == 0, UNJUDGED, picture.things)
    sample = sample_patch(replace(picture, things=around), 96, np.random.default_rng(0))
    assert UNJUDGED in sample.things
    beside = sample.things[::2, ::2] == UNJUDGED
    assert (sample.label[beside] == -1).all() and (sample.weight[beside] == 0).all()


def test_colours_stay_colours():
    rgb = np.random.default_rng(0).random((32, 32, 3)).astype(np.float32) - 0.5
    drawn = [vary_colours(rgb, np.random.default_rng(seed)) for seed in range(20)]
    assert all(np.abs(image).max() <= 0.5 and image.dtype == np.float32 for image in drawn)
    assert np.std([image.mean() for image in drawn]) > 0.03
