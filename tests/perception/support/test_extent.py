"""Extents of tables of known size above a floor."""

import numpy as np
import pytest

from perception.support.extent import ExtentConfig, seen_extent
from perception.support.planes import PlaneConfig
from perception.support.samples import sample_frames
from perception.support.surface import SupportSurface
from perception.types import SupportPlane

PLANES, CONFIG = PlaneConfig(), ExtentConfig()
HEIGHT = 0.5


def table(scenes, x=0.0, y=0.0, half=(0.3, 0.2), height=HEIGHT):
    return scenes.Solid(x, y, 0.02, half=half, bottom=height - 0.02)


def extent_at(scenes, solids, height=HEIGHT, eye=(0, -0.8, 1.0), noise=0.001):
    frame = scenes.render(solids, scenes.look_at(eye, (0, 0, HEIGHT)), noise).frame
    samples = sample_frames([frame], PLANES.max_points, PLANES.max_depth)
    return samples, seen_extent(samples, SupportPlane(offset=height), PLANES, CONFIG)


def outline(extent):
    return SupportSurface(extent.plane, extent.grid.polygon(extent.hull))


def test_the_extent_is_the_table(scenes):
    samples, extent = extent_at(scenes, [table(scenes)])
    x, y = np.meshgrid(np.linspace(-0.45, 0.45, 46), np.linspace(-0.35, 0.35, 36))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT)], axis=1)
    true = np.maximum(np.abs(points[:, 0]) - 0.3, np.abs(points[:, 1]) - 0.2)
    beyond = outline(extent).beyond(points)
    assert (beyond[true < -0.04] < 0).all() and (beyond[true > 0.03] > 0).all()
    top = np.abs(samples.points[:, 2] - HEIGHT) < 0.007
    assert extent.shown[top].mean() > 0.95 and not extent.shown[~top].any()


def test_things_and_their_shadows_leave_no_hole(scenes):
    solids = [table(scenes), scenes.Solid(0, -0.05, 0.25, half=(0.1, 0.02), bottom=HEIGHT)]
    _, extent = extent_at(scenes, solids)
    hidden = np.array([[0.0, -0.05, HEIGHT], [0.0, 0.05, HEIGHT], [0.0, 0.15, HEIGHT]])
    assert (outline(extent).beyond(hidden) < 0).all()


def test_parts_behind_a_see_through_gap_are_another_surface(scenes):
    near, far = table(scenes, y=-0.1, half=(0.4, 0.1)), table(scenes, y=0.4, half=(0.2, 0.08))
    _, extent = extent_at(scenes, [near, far])
    assert (outline(extent).beyond(np.array([[0.0, 0.4, HEIGHT]])) > 0.3).all()


def test_a_plane_through_the_sides_of_things_has_no_extent(scenes):
    solids = [scenes.Solid(x, 0, 0.4, half=(0.06, 0.05)) for x in (-0.3, 0.0, 0.3)]
    assert extent_at(scenes, solids, height=0.2)[1] is None


@pytest.mark.parametrize(("half", "seen"), [(0.04, False), (0.08, True)])
def test_a_surface_is_at_least_as_large_as_a_side_plate(scenes, half, seen):
    _, extent = extent_at(scenes, [table(scenes, half=(half, half))])
    assert (extent is not None) == seen


def test_a_surface_at_a_grazing_angle_is_connected(scenes):
    _, extent = extent_at(scenes, [table(scenes, half=(0.3, 0.5))], eye=(0, -1.2, HEIGHT + 0.35))
    points = np.array([[0.0, y, HEIGHT] for y in (-0.45, 0.0, 0.42)])
    assert (outline(extent).beyond(points) < 0).all()


def test_a_view_from_below_sees_nothing_through_the_plane(scenes):
    views = ((0, -0.8, 1.0), (0, -0.8, 0.2))  # the second camera is lower than the table
    frames = [scenes.render([table(scenes)], scenes.look_at(eye, (0, 0, HEIGHT))).frame for eye in views]
    samples = sample_frames(frames, PLANES.max_points, PLANES.max_depth)
    extent = seen_extent(samples, SupportPlane(offset=HEIGHT), PLANES, CONFIG)
    assert extent is not None
    assert sorted(np.ptp(outline(extent).outline, axis=0)) == pytest.approx([0.4, 0.6], abs=0.06)
