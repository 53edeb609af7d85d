"""Things on a table that are known from its construction."""

import numpy as np
import pytest

from perception.support.extent import ExtentConfig, seen_extent
from perception.support.planes import PlaneConfig
from perception.support.samples import sample_frames
from perception.support.things import is_vessel_bottom, things_on
from perception.types import SupportPlane

PLANES = PlaneConfig()


def things_of(scenes, solids, plane=SupportPlane(), eye=(0, -0.8, 0.7), noise=0.001):
    frame = scenes.render(solids, scenes.look_at(eye, (0, 0.1, 0)), noise, (640, 480)).frame
    samples = sample_frames([frame], PLANES.max_points, PLANES.max_depth)
    extent = seen_extent(samples, plane, PLANES, ExtentConfig())
    assert extent is not None
    return samples, extent, things_on(samples, extent, np.zeros(len(samples.valid), bool))


def test_each_separate_thing_is_one(scenes):
    places = [(-0.2, 0.0), (0.0, 0.1), (0.2, -0.05)]
    solids = [scenes.Solid(x, y, 0.1, radius=0.035) for x, y in places]
    samples, _, (index, count) = things_of(scenes, solids)
    assert count == 3
    for k in range(3):
        centre = samples.points[index == k, :2].mean(0)
        assert min(np.hypot(*(centre - place)) for place in places) < 0.04


@pytest.mark.parametrize(
    "solid",
    [
        {"height": 0.6, "half": (0.05, 0.05)},  # too high
        {"height": 0.1, "half": (0.05, 0.05), "bottom": 0.15},  # floats
        {"height": 0.008, "half": (0.05, 0.05)},  # flat
    ],
)
def test_what_stands_on_no_table_is_no_thing(scenes, solid):
    _, _, (_, count) = things_of(scenes, [scenes.Solid(0, 0.1, **solid)])
    assert count == 0


def test_what_shows_another_surface_is_no_thing(scenes):
    solids = [scenes.Solid(0, 0.1, 0.1, half=(0.1, 0.1))]
    samples, extent, (index, count) = things_of(scenes, solids)
    assert count == 1
    assert things_on(samples, extent, index == 0)[1] == 0


def test_things_beyond_the_edge_belong_to_another_surface(scenes):
    solids = [
        scenes.Solid(0, 0, 0.02, half=(0.25, 0.2), bottom=0.48),
        scenes.Solid(0, 0, 0.1, radius=0.035, bottom=0.5),
        scenes.Solid(0.45, 0, 0.62, radius=0.035),  # stands beside the table and rises above it
    ]
    _, _, (_, count) = things_of(scenes, solids, SupportPlane(offset=0.5), eye=(0, -0.8, 1.2))
    assert count == 1


def test_the_bottom_of_a_dish_is_told_from_a_lid(scenes):
    ring = [
        scenes.Solid(0.12 * np.cos(a), 0.12 * np.sin(a), 0.08, radius=0.025) for a in np.arange(0, 6.28, 0.3)
    ]
    dish = [scenes.Solid(0, 0, 0.03, radius=0.11), *ring]
    lid = [scenes.Solid(0, 0, 0.03, radius=0.11), scenes.Solid(0, 0, 0.08, radius=0.03)]
    for solids, expected in ((dish, True), (lid, False)):
        samples, extent, _ = things_of(scenes, solids, SupportPlane(offset=0.03), eye=(0, -0.3, 0.8))
        assert is_vessel_bottom(samples, extent) == expected
