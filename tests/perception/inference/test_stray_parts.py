"""Parts of masks across a gap, on depth images of a cylinder from above with something beside it."""

import numpy as np
import pytest
import trimesh

from perception.inference.stray_parts import GAP, without_stray_parts
from perception.types import CameraIntrinsics, ObjectDetection, ObjectEstimate, RgbdFrame, TriangleMesh

HEIGHT, TOP, F = 0.6, 0.5, 400.0
T_WORLD_CAMERA = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, HEIGHT], [0.0, 0.0, 0.0, 1.0]]
)
v, u = np.mgrid[:160, :200]
BODY = np.hypot(u - 99.5, v - 79.5) < 32  # 0.04 m at a height of 0.1 m
PIXEL = TOP / F  # [m]


@pytest.fixture(scope="module")
def body():
    shape = trimesh.creation.cylinder(0.04, HEIGHT - TOP, sections=48)
    shape.apply_translation((0, 0, (HEIGHT - TOP) / 2))
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    return ObjectEstimate(7, "can", np.zeros(16), np.eye(4), np.full(3, 0.05), mesh, 0.9)


def strip(left, right):
    return (np.abs(v - 79.5) < 6) & (u > left) & (u < right)


def image_with(part, depth=TOP):
    image = np.full((160, 200), HEIGHT, np.float32)
    image[part] = depth
    image[BODY] = TOP
    camera = CameraIntrinsics(200, 160, F, F, 99.5, 79.5)
    return RgbdFrame(0.0, np.zeros((160, 200, 3), np.uint8), image, camera, T_WORLD_CAMERA)


def left_out(body, frames, masks):
    """The pixels of each mask that are left out."""
    other = ObjectDetection("mug", 0.9, strip(150, 190), instance_id=8)
    rows = [[ObjectDetection("can", 0.9, mask, instance_id=7), other] for mask in masks]
    found = without_stray_parts(frames, rows, {7: body}, {7})
    assert all(row[1] is other for row in found), "those of other objects stay as they are"
    return [mask & ~row[0].mask for mask, row in zip(masks, found, strict=True)]


HANDLE, CABLE = strip(131, 160) & ~BODY, strip(131 + 2 * GAP / PIXEL, 165)


def test_what_continues_the_surface_is_of_the_object(body):
    (out,) = left_out(body, [image_with(HANDLE)], [BODY | HANDLE])
    assert not out.any()


def test_what_is_beyond_a_gap_is_not(body):
    (out,) = left_out(body, [image_with(CABLE)], [BODY | CABLE])
    assert (out & CABLE).sum() > 0.8 * CABLE.sum() and not (out & ~CABLE).any()


@pytest.mark.parametrize(("n_gaps", "is_left_out"), [(1, False), (2, True)])
def test_a_gap_that_enough_other_views_show_counts(body, n_gaps, is_left_out):
    bridge = strip(131, 146)
    frames = [image_with(CABLE)] * n_gaps + [image_with(CABLE | bridge)]
    masks = [BODY | CABLE] * n_gaps + [BODY | CABLE | bridge]
    out = left_out(body, frames, masks)[-1]
    assert ((out & CABLE).sum() > 0.8 * CABLE.sum()) == is_left_out
    assert not (out & BODY).any()


def test_an_object_that_nothing_of_its_mask_is_near_keeps_it(body):
    mask = strip(180, 195)
    (out,) = left_out(body, [image_with(mask)], [mask])
    assert not out.any()
