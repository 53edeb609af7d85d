"""Pixels of a fit: classification, targets, weights and the sampled depth range."""

from dataclasses import replace

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.geometry import rigid, so3_exp
from perception.inference.observation import (
    Crop,
    ObjectObservation,
    PixelConfig,
    SamplingRange,
    gather_pixels,
    measured_points,
    pixel_rays,
    ray_samples,
    sampling_radius,
)
from perception.rendering.kernel import ESCAPE_FACTOR
from perception.types import CameraIntrinsics, RgbdFrame

SIDE = 60
CAMERA = CameraIntrinsics(width=SIDE, height=SIDE, fx=50.0, fy=60.0, cx=29.5, cy=30.5)
RANGE = SamplingRange(np.array([0.0, 0.0, 0.5]), 0.2, 50)
EVERY_PIXEL = Crop(1000)
PLAIN = PixelConfig(ring=0.4, band=2.0, background_weight=0.25)


def observation(depth: np.ndarray | None = None, **more) -> ObjectObservation:
    """A square object of 20 x 20 pixels at 0.5 m before a wall at 0.6 m, seen from the world's origin."""
    mask = np.zeros((SIDE, SIDE), bool)
    mask[20:40, 20:40] = True
    if depth is None:
        depth = np.where(mask, 0.5, 0.6).astype(np.float32)
    frame = RgbdFrame(0.0, np.zeros((SIDE, SIDE, 3), np.uint8), depth, CAMERA, np.eye(4))
    return ObjectObservation(frame, mask, **more)


def image_of(pixels, values: np.ndarray) -> np.ndarray:
    """Values of the pixels as an image, NaN elsewhere."""
    u = np.rint(pixels.rays.directions[:, 0] * CAMERA.fx + CAMERA.cx).astype(int)
    v = np.rint(pixels.rays.directions[:, 1] * CAMERA.fy + CAMERA.cy).astype(int)
    image = np.full((SIDE, SIDE), np.nan)
    image[v, u] = values
    return image


def test_sampling_radius_adds_a_margin_of_15_mm():
    assert sampling_radius(0.05) == pytest.approx(0.065)


@pytest.mark.parametrize(("step", "count"), [(0.005, 40), (0.0051, 39), (0.1, 24), (1e-4, 192)])
def test_ray_samples_cover_the_depth_range_within_bounds(step, count):
    assert ray_samples(0.1, step) == count


def test_sampling_range_around_a_sphere():
    sampling = SamplingRange.around(np.ones(3), 0.085, 0.004)
    assert sampling.reach == pytest.approx(0.1) and sampling.samples == 50
    np.testing.assert_array_equal(sampling.centre, np.ones(3))


def test_pixel_rays_invert_the_projection():
    u, v = np.array([29.5, 79.5]), np.array([30.5, 0.5])
    np.testing.assert_allclose(pixel_rays(observation().frame, u, v), [[0, 0, 1], [1, -0.5, 1]])


def test_observations_need_a_camera_pose_and_a_mask_of_the_images_size():
    seen = observation()
    with pytest.raises(InvalidInputError, match="without camera pose"):
        ObjectObservation(replace(seen.frame, T_world_camera=None), seen.mask)
    with pytest.raises(InvalidInputError, match=r"mask is \(60, 59\), its image \(60, 60\)"):
        ObjectObservation(seen.frame, seen.mask[:, :-1])


def test_object_and_background_are_apart_by_the_band_and_within_the_ring():
    pixels = gather_pixels([observation()], RANGE, EVERY_PIXEL, PLAIN)
    inside = image_of(pixels, pixels.inside)
    row = inside[30]  # mask from 20 to 39, band of 2 pixels, ring of 8
    np.testing.assert_array_equal(np.flatnonzero(row == 1), np.arange(22, 38))
    np.testing.assert_array_equal(np.flatnonzero(row == 0), [*range(12, 18), *range(42, 48)])


def test_targets_are_the_measured_depth_or_the_escape_depth():
    pixels = gather_pixels([observation()], RANGE, EVERY_PIXEL, PLAIN)
    np.testing.assert_allclose(pixels.rays.depth_range, [[0.3, 0.7]])
    assert pixels.rays.samples == 50
    np.testing.assert_allclose(pixels.target[pixels.inside], 0.5)
    np.testing.assert_allclose(pixels.target[~pixels.inside], ESCAPE_FACTOR * 0.7, rtol=1e-6)
    np.testing.assert_array_equal(pixels.weight, np.where(pixels.inside, 1.0, 0.25))


def test_the_sampled_range_never_starts_at_the_camera():
    near = SamplingRange(np.array([0.0, 0.0, 0.5]), 0.6, 50)
    pixels = gather_pixels([observation()], near, EVERY_PIXEL, PLAIN)
    np.testing.assert_allclose(pixels.rays.depth_range, [[0.02, 1.1]])


@pytest.mark.parametrize("crop", [Crop(1000), Crop(30), Crop(30, 1)])
def test_depth_holes_are_no_measurements(crop):
    """Neither on the object nor on the background."""
    seen = observation()
    depth = seen.frame.depth.copy()
    depth[:, ::2] = 0.0
    pixels = gather_pixels([observation(depth)], RANGE, crop, PLAIN)
    assert pixels.inside.any() and (~pixels.inside).any()
    u = np.rint(pixels.rays.directions[:, 0] * CAMERA.fx + CAMERA.cx).astype(int)
    assert (u % 2 == 1).all()
    assert (pixels.target > 0.4).all()


def test_ignored_pixels_and_depth_out_of_range_are_left_out():
    ignore = np.zeros((SIDE, SIDE), bool)
    ignore[:, 30:] = True
    depth = observation().frame.depth.copy()
    depth[:30] = np.where(depth[:30] == 0.5, 0.29, depth[:30])  # before the sampled range
    depth[38:40, :] = 0.71  # behind it
    pixels = gather_pixels([observation(depth, ignore=ignore)], RANGE, EVERY_PIXEL, PLAIN)
    inside = image_of(pixels, pixels.inside)
    assert np.isnan(inside[:, 30:]).all()
    np.testing.assert_array_equal(np.flatnonzero((inside == 1).any(axis=1)), np.arange(30, 38))


def test_world_points_leave_out_holes_ignored_pixels_and_the_border():
    ignore = np.zeros((SIDE, SIDE), bool)
    ignore[:, 35:] = True
    depth = observation().frame.depth.copy()
    depth[:30] = 0.0
    T = rigid(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([1.0, 2.0, 3.0]))
    seen = observation(depth, ignore=ignore)
    seen = ObjectObservation(replace(seen.frame, T_world_camera=T), seen.mask, ignore)
    points = seen.points_world()
    assert len(points) == 8 * 13  # rows 31 to 38, columns 21 to 33
    np.testing.assert_allclose(points[:, 2], 3.5, rtol=1e-6)
    np.testing.assert_allclose(points[:, 1].min(), 2 + 0.5 * (21 - 29.5) / 50, atol=1e-6)  # x becomes y
    np.testing.assert_allclose(points[:, 0].max(), 1 - 0.5 * (31 - 30.5) / 60, atol=1e-6)


def test_small_masks_keep_their_border():
    seen = observation()
    mask = np.zeros_like(seen.mask)
    mask[30:34, 30:34] = True
    assert len(ObjectObservation(seen.frame, mask).points_world()) == 16


def test_measured_points_of_several_views(can):
    """Eroded by more, fewer are left; without a view there are none."""
    views = can.observations((0.0, 1.5))
    points = measured_points(views)
    np.testing.assert_array_equal(points, np.concatenate([view.points_world() for view in views]))
    assert 0 < len(measured_points(views, erode=3)) < len(points)
    assert measured_points(()).shape == (0, 3)


def test_rays_of_several_views_follow_each_other():
    two = [observation(), observation()]
    pixels = gather_pixels(two, RANGE, Crop(30, 1), PLAIN, threads=2)
    assert pixels.rays.threads == 2 and pixels.Ts_world_camera.shape == (2, 4, 4)
    half = len(pixels.target) // 2
    np.testing.assert_array_equal(pixels.rays.view, np.repeat([0, 1], half))
    assert pixels.operator is not None and pixels.operator.shape[1] == 2 * half
    majority = pixels.operator @ pixels.inside.astype(float) > 0.5
    np.testing.assert_array_equal(pixels.is_object, majority)


def test_every_other_background_pixel_stands_for_two():
    sparse = replace(PLAIN, sparse_background=True)
    all_pixels, fewer = (gather_pixels([observation()], RANGE, EVERY_PIXEL, c) for c in (PLAIN, sparse))
    assert (~fewer.inside).sum() == pytest.approx((~all_pixels.inside).sum() / 2, rel=0.05)
    np.testing.assert_array_equal(np.unique(fewer.weight), [0.5, 1.0])
    assert fewer.inside.sum() == all_pixels.inside.sum()
    kept = ~np.isnan(image_of(fewer, ~fewer.inside))
    kept[19:41, 19:41] = False
    assert not (kept[:, 1:] & kept[:, :-1]).any()  # a chessboard has no neighbours
    blurred = gather_pixels([observation()], RANGE, Crop(1000, 1), sparse)
    np.testing.assert_array_equal(np.unique(blurred.weight), [0.25, 1.0])


def test_weights_are_the_areas_relative_to_the_reference_crop():
    sums = {}
    for size in (12, 18, 24, 36):  # the window is 36 pixels wide
        pixels = gather_pixels([observation()], RANGE, Crop(size, reference=18), PLAIN)
        sums[size] = float(pixels.weight[pixels.inside].sum())
        np.testing.assert_allclose(np.unique(pixels.weight), np.array([0.25, 1.0]) * (18 / size) ** 2)
    for total in sums.values():
        assert total == pytest.approx(sums[18], rel=0.15)
