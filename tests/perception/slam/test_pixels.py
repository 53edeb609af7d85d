"""Selected pixels: inside masks, in their rings and on the plane."""

from dataclasses import replace

import numpy as np
import pytest

from perception.slam.keyframes import Keyframe
from perception.slam.pixels import BEHIND, PixelSelectionConfig, in_observed_parts, select_pixels
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane


@pytest.fixture(scope="module")
def view(observe, T_view):
    return observe(T_view, noise=0.0)


def columns_rows(view, directions):
    k = view.frame.intrinsics
    u, v = directions[:, 0] * k.fx + k.cx, directions[:, 1] * k.fy + k.cy
    return np.rint(u).astype(int), np.rint(v).astype(int)


def test_pixels_avoid_mask_borders_and_other_masks(cylinders, view):
    id = view.landmark_of[1]
    alone = replace(view, landmark_of={1: id})
    config = PixelSelectionConfig()
    pixels = select_pixels(alone, cylinders.plane, config)
    assert set(pixels.landmark_ids) == {id}
    u, v = columns_rows(view, pixels.directions)
    band = config.border_band - 1
    for row, column, inside in zip(v, u, pixels.is_object):
        patch = view.labels[max(row - band, 0) : row + band + 1, max(column - band, 0) : column + band + 1]
        assert (patch == (1 if inside else 0)).all()
    np.testing.assert_array_equal(pixels.depth, view.frame.depth[v, u])


def test_pixels_are_limited_in_number_and_spread_over_the_mask(cylinders, view):
    config = PixelSelectionConfig(object_pixels=50, ring_pixels=20, plane_pixels=30)
    pixels = select_pixels(view, cylinders.plane, config)
    for label, id in view.landmark_of.items():
        own = pixels.landmark_ids == id
        assert (own & pixels.is_object).sum() == 50 and 5 < (own & ~pixels.is_object).sum() <= 20
        _, v = columns_rows(view, pixels.directions[own & pixels.is_object])
        rows = np.nonzero(view.labels == label)[0]
        assert np.ptp(v) > 0.7 * np.ptp(rows)
    assert len(pixels.plane_points) == 30


def test_ring_pixels_lie_within_the_ring_width(cylinders, view):
    pixels = select_pixels(view, cylinders.plane, PixelSelectionConfig(ring_width=5))
    u, v = columns_rows(view, pixels.directions[~pixels.is_object])
    for row, column, id in zip(v, u, pixels.landmark_ids[~pixels.is_object]):
        label = next(label for label, other in view.landmark_of.items() if other == id)
        patch = view.labels[max(row - 5, 0) : row + 6, max(column - 5, 0) : column + 6]
        assert label in patch


def test_ring_pixels_of_possible_occluders_are_excluded(cylinders, view):
    """Unlabelled matter in front of the objects' surroundings leaves no ring pixels."""
    depth = np.where(view.labels == 0, 0.2, view.frame.depth).astype(np.float32)
    frame = replace(view.frame, depth=depth)
    pixels = select_pixels(replace(view, frame=frame), cylinders.plane)
    assert pixels.is_object.all() and len(pixels.plane_points) == 0
    far = np.where(view.labels == 0, view.frame.depth.max() + 2 * BEHIND, view.frame.depth)
    behind = replace(view.frame, depth=far.astype(np.float32))
    pixels = select_pixels(replace(view, frame=behind), cylinders.plane)
    assert (~pixels.is_object).any() and len(pixels.plane_points) == 0


def test_ring_pixels_off_the_plane_must_be_clearly_behind_the_object(view):
    """The farthest visible part is the 98 % quantile of the object's depths, and the margin is ``BEHIND``."""
    alone, below = replace(view, landmark_of={1: view.landmark_of[1]}), SupportPlane(offset=-1.0)
    own = select_pixels(alone, below)
    far = np.sort(own.depth[own.is_object])[int(0.98 * own.is_object.sum())]

    def n_ring_pixels(margin):
        depth = np.where(view.labels == 0, far + margin, view.frame.depth).astype(np.float32)
        return (~select_pixels(replace(alone, frame=replace(view.frame, depth=depth)), below).is_object).sum()

    assert n_ring_pixels(0.9 * BEHIND) == 0 and n_ring_pixels(1.1 * BEHIND) > 20


def test_ring_pixels_on_the_plane_may_be_nearer_than_parts_of_the_object(cylinders, view):
    pixels = select_pixels(replace(view, landmark_of={1: view.landmark_of[1]}), cylinders.plane)
    assert pixels.depth[~pixels.is_object].min() < pixels.depth[pixels.is_object].max()


def test_depth_holes_are_no_pixels(cylinders, view):
    depth = np.array(view.frame.depth)
    depth[::2] = 0
    pixels = select_pixels(replace(view, frame=replace(view.frame, depth=depth)), cylinders.plane)
    assert len(pixels.depth) and (pixels.depth > 0).all() and (pixels.plane_points[:, 2] > 0).all()


def test_plane_points_lie_on_the_plane(cylinders, view, T_view):
    points = select_pixels(view, cylinders.plane).plane_points
    heights = points @ T_view[2, :3] + T_view[2, 3]
    assert len(points) == 300 and np.abs(heights).max() < 1e-3


def test_larger_images_are_subsampled_to_the_same_pixels(cylinders, view):
    k = view.frame.intrinsics
    double = CameraIntrinsics(2 * k.width, 2 * k.height, 2 * k.fx, 2 * k.fy, 2 * k.cx, 2 * k.cy)

    def enlarged(image):
        return np.repeat(np.repeat(image, 2, axis=0), 2, axis=1)

    frame = view.frame
    large = RgbdFrame(0.0, enlarged(frame.rgb), enlarged(frame.depth), double, frame.T_world_camera)
    small_pixels = select_pixels(view, cylinders.plane)
    large_pixels = select_pixels(replace(view, frame=large, labels=enlarged(view.labels)), cylinders.plane)
    np.testing.assert_allclose(large_pixels.directions, small_pixels.directions, atol=1e-12)
    np.testing.assert_array_equal(large_pixels.depth, small_pixels.depth)
    np.testing.assert_allclose(large_pixels.plane_points, small_pixels.plane_points, atol=1e-9)


def test_subset_keeps_all_plane_points(cylinders, view):
    pixels = select_pixels(view, cylinders.plane)
    chosen = pixels.landmark_ids == 1
    subset = pixels.subset(chosen)
    assert set(subset.landmark_ids) == {1} and len(subset.depth) == chosen.sum()
    np.testing.assert_array_equal(subset.directions, pixels.directions[chosen])
    assert subset.plane_points is pixels.plane_points


def test_parts_of_truncated_landmarks_that_no_keyframe_had_in_view_are_rejected(cylinders, view, T_view):
    """A keyframe at the same pose whose image ends at the middle of landmark 0."""
    world = cylinders.map()
    world = world.with_landmarks(replace(world.landmarks[0], truncated=True))
    pixels, k = select_pixels(view, cylinders.plane), view.frame.intrinsics
    own = (pixels.landmark_ids == 0) & pixels.is_object
    column = pixels.directions[:, 0] * k.fx + k.cx
    shift = np.median(column[own]) - (k.width - 3)
    narrow = RgbdFrame(0.0, view.frame.rgb, view.frame.depth, replace(k, cx=k.cx - shift), T_view)
    key = Keyframe.of(replace(view, frame=narrow), np.eye(6))
    observed = in_observed_parts(pixels, world, [key], T_view)
    assert observed[pixels.landmark_ids != 0].all()
    in_view = column - shift <= k.width - 3
    assert (observed[own] == in_view[own]).mean() > 0.98 and 0.3 < observed[own].mean() < 0.7
    ring = (pixels.landmark_ids == 0) & ~pixels.is_object
    assert (observed[ring] == in_view[ring]).mean() > 0.98
    assert in_observed_parts(pixels, world, [key, Keyframe.of(view, np.eye(6))], T_view).all()
    assert in_observed_parts(pixels, world, [key.without_landmarks({0})], T_view).all()
