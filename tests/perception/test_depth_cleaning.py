"""Cleaning of depth: flying and isolated pixels go, surfaces, rims and thin parts stay."""

import gc
import weakref

import numpy as np
import pytest

from perception.depth_cleaning import BAND, beside_jumps, clean_depth, clean_frame
from perception.types import CameraIntrinsics, RgbdFrame

CAMERA = CameraIntrinsics(160, 120, 600.0, 600.0, 79.5, 59.5)


def box_before_wall():
    depth = np.full((120, 160), 0.9, dtype=np.float32)
    depth[30:90, 40:100] = 0.7
    return depth


def test_surfaces_and_sharp_edges_stay():
    depth = box_before_wall()
    assert np.array_equal(clean_depth(depth, CAMERA), depth)


def test_depths_between_two_surfaces_go():
    depth = box_before_wall()
    ramp = {29: 0.75, 28: 0.8, 27: 0.85}
    for row, value in ramp.items():
        depth[row, 40:100] = value
    depth[30:90, 100] = 0.8
    cleaned = clean_depth(depth, CAMERA)
    assert not cleaned[27:30, 42:98].any() and not cleaned[32:88, 100].any()
    rest = np.ones_like(depth, dtype=bool)
    rest[27:91, 38:102] = False
    rest[31:89, 41:99] = True
    assert np.array_equal(cleaned[rest], depth[rest])


@pytest.mark.parametrize("transform", [np.array, np.transpose, np.flipud, np.fliplr])
def test_every_direction_counts_alike(transform):
    depth = box_before_wall()
    depth[30:90, 100] = 0.8
    height, width = transform(depth).shape
    camera = CameraIntrinsics(width, height, 600.0, 600.0, 70.0, 60.0)
    moved = np.ascontiguousarray(transform(depth))
    assert np.array_equal(clean_depth(moved, camera), transform(clean_depth(depth, CAMERA)))


@pytest.mark.parametrize(("degrees", "kept"), [(0, True), (60, True), (77, True), (87, False)])
def test_slopes_stay_up_to_grazing_incidence(degrees, kept):
    y = (np.arange(120) - CAMERA.cy)[:, None] / CAMERA.fy
    tangent = np.tan(np.radians(degrees))
    depth = np.broadcast_to(0.8 / (1 - tangent * y), (120, 160)).astype(np.float32)
    near_axis = clean_depth(np.where(depth > 0, depth, 0), CAMERA)[56:64, 20:140]
    assert (near_axis > 0).all() if kept else not near_axis.any()


def test_isolated_pixels_go_and_thin_parts_stay():
    depth = np.full((120, 160), 0.9, dtype=np.float32)
    depth[20, 20] = 0.7  # alone
    depth[40:80, 60:62] = 0.7  # a strip of two pixels
    depth[60, 90:130] = 0  # a line of holes
    cleaned = clean_depth(depth, CAMERA)
    assert cleaned[20, 20] == 0
    cleaned[20, 20] = 0.7
    assert np.array_equal(cleaned, depth)


def test_pixels_alone_in_a_hole_go():
    depth = np.zeros((120, 160), dtype=np.float32)
    depth[50:52, 50] = 0.8
    depth[80:83, 80:83] = 0.8
    cleaned = clean_depth(depth, CAMERA)
    assert not cleaned[:60].any() and np.array_equal(cleaned[60:], depth[60:])


@pytest.mark.parametrize("distance", [0.4, 0.8, 1.5, 3.0])
def test_noise_that_grows_with_the_square_of_distance_is_tolerated(distance):
    rng = np.random.default_rng(0)
    sigma = 0.08 * distance**2 / 30
    depth = (distance + sigma * rng.standard_normal((120, 160))).astype(np.float32)
    assert (clean_depth(depth, CAMERA) > 0).mean() > 0.995


def test_bands_of_rows_leave_no_trace():
    rng = np.random.default_rng(1)
    depth = np.where(rng.random((120, 160)) < 0.5, 0.8, 0.8 + 0.1 * rng.random((120, 160)))
    depth = depth.astype(np.float32)
    shifted = np.roll(depth, BAND // 2, axis=0)
    first, second = clean_depth(depth, CAMERA), clean_depth(shifted, CAMERA)
    inner = slice(BAND // 2 + 1, -1)
    assert np.array_equal(second[inner], np.roll(first, BAND // 2, axis=0)[inner])


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (2, 2), (41, 3)])
def test_any_size(shape):
    depth = np.full(shape, 0.5, dtype=np.float32)
    camera = CameraIntrinsics(shape[1], shape[0], 600.0, 600.0, 0.0, 0.0)
    assert clean_depth(depth, camera).shape == shape


def test_a_frame_keeps_all_but_its_depth():
    depth = box_before_wall()
    depth[5, 5] = 0.3
    rgb = np.zeros((120, 160, 3), dtype=np.uint8)
    frame = RgbdFrame(1.5, rgb, depth, CAMERA, np.eye(4))
    cleaned = clean_frame(frame)
    assert cleaned.depth[5, 5] == 0 and frame.depth[5, 5] == np.float32(0.3)
    assert cleaned.time == 1.5 and cleaned.intrinsics == CAMERA and cleaned.T_world_camera is not None


def test_a_frame_is_cleaned_once_and_forgotten_with_it():
    def seen():
        return RgbdFrame(0.0, np.zeros((120, 160, 3), np.uint8), box_before_wall(), CAMERA)

    frame = seen()
    cleaned = clean_frame(frame)
    assert clean_frame(frame) is cleaned and clean_frame(seen()) is not cleaned
    assert clean_frame(cleaned) is not cleaned  # cleaning twice removes more at the edges of what is left
    kept = weakref.ref(cleaned)
    del frame, cleaned
    gc.collect()
    assert kept() is None


def test_pixels_on_both_sides_of_a_step_are_beside_it():
    """Only steps between the given pixels count."""
    depth = np.full((6, 8), 0.5, np.float32)
    depth[:, 4:] = 0.52
    every = np.ones(depth.shape, bool)
    step = np.zeros(depth.shape, bool)
    step[:, 3:5] = True
    np.testing.assert_array_equal(beside_jumps(every, depth, 0.015), step)
    assert not beside_jumps(every, depth, 0.025).any()
    left = every & (np.arange(8) < 4)
    assert not beside_jumps(left, depth, 0.015).any()
