"""Ends that masks lack, on depth images of a lying cylinder from above, with a neck or a thing beside it."""

import numpy as np
import pytest
import trimesh

from perception.inference.lost_ends import GAP, LONGEST, with_lost_ends
from perception.types import (
    CameraIntrinsics,
    ObjectDetection,
    ObjectEstimate,
    RgbdFrame,
    SupportPlane,
    TriangleMesh,
)

HEIGHT, F = 0.6, 400.0  # [m] of the camera, [px]
RADIUS, HALF, NECK = 0.03, 0.06, 0.024  # [m]
SHAPE = (200, 320)
T_WORLD_CAMERA = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, HEIGHT], [0.0, 0.0, 0.0, 1.0]]
)
PLANE = SupportPlane()


def body(x, y):
    """Height [m] of a cylinder about the x axis that lies on the plane; 0 beside it."""
    return np.where(
        (np.abs(x) < HALF) & (np.abs(y) < RADIUS), RADIUS + np.sqrt(np.maximum(RADIUS**2 - y**2, 0)), 0
    )


def neck(low=HALF, high=HALF + 0.04, radius=NECK, aside=0.0):
    """The same of a narrower one between two places along the axis [m], perhaps beside it."""

    def height(x, y):
        y = y - aside
        inside = (low <= x) & (x < high) & (np.abs(y) < radius)
        return np.where(inside, RADIUS + np.sqrt(np.maximum(radius**2 - y**2, 0)), 0)

    return height


def block(x, y):
    """A thing that touches the base over all its width, and goes on beside it."""
    return np.where((x < -HALF) & (x > -HALF - 0.05) & (np.abs(y) < 0.07), 0.05, 0)


def image(*shapes):
    """A depth image of shapes, and the pixels of the first one."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    u, v = (u - SHAPE[1] / 2 + 0.5) / F, (v - SHAPE[0] / 2 + 0.5) / F
    depth = np.full(SHAPE, HEIGHT - RADIUS)
    for _ in range(5):  # the place of a pixel depends on its depth
        heights = [shape(u * depth, -v * depth) for shape in shapes]
        depth = HEIGHT - np.max(heights, axis=0)
    camera = CameraIntrinsics(SHAPE[1], SHAPE[0], F, F, SHAPE[1] / 2 - 0.5, SHAPE[0] / 2 - 0.5)
    frame = RgbdFrame(0.0, np.zeros((*SHAPE, 3), np.uint8), depth.astype(np.float32), camera, T_WORLD_CAMERA)
    return frame, heights[0] > 0


def lying(id, x=0.0, radius=RADIUS, half=HALF):
    """A lying bottle, its axis along x."""
    shape = trimesh.creation.cylinder(radius, 2 * half, sections=64)
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    T[:3, 3] = x, 0, RADIUS
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    return ObjectEstimate(id, "bottle", np.zeros(16), T, np.full(3, 0.05), mesh, 0.9, resting="lying")


def extensions(*images, others=(), left_out=0.0):
    """What is added to the body's masks in each view; an empty list if there are no lost ends."""
    frames, masks = zip(*images)
    u = np.mgrid[: SHAPE[0], : SHAPE[1]][1]
    masks = [mask & (u < np.quantile(u[mask], 1 - left_out)) for mask in masks]
    rows = [[ObjectDetection("bottle", 0.9, mask, instance_id=4)] for mask in masks]
    known = {e.id: e for e in (lying(4), *others)}
    found = with_lost_ends(frames, rows, known, [4], PLANE)
    return [None if m is None else m & ~mask for m, mask in zip(found.get(4, ()), masks)]


def test_what_goes_on_along_the_axis_is_an_end():
    (frame, mask), narrow = image(body, neck()), neck()
    added = extensions((frame, mask))[0]
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x = (u - SHAPE[1] / 2 + 0.5) / F * frame.depth
    y = -(v - SHAPE[0] / 2 + 0.5) / F * frame.depth
    expected = (narrow(x, y) > 0) & (x > HALF + 0.007)
    assert (added & expected).sum() > 0.9 * expected.sum()
    assert (x[added] > HALF - 0.002).all() and (np.abs(y[added]) < NECK + 0.001).all()


def test_the_mask_gets_all_that_the_shape_explains():
    frame, mask = image(body, neck())
    added = extensions((frame, mask), left_out=0.3)[0]
    u = np.mgrid[: SHAPE[0], : SHAPE[1]][1]
    cut = mask & (u >= np.quantile(u[mask], 0.7))
    assert (added & cut).sum() > 0.95 * cut.sum()


@pytest.mark.parametrize(
    "beside",
    [
        neck(low=HALF + GAP + 0.01, high=HALF + 0.08),  # apart
        neck(radius=RADIUS + 0.02),  # wider than the shape's end
        neck(aside=0.05, radius=0.02),  # beside the axis
        neck(high=HALF + 2 * LONGEST),  # too long
        block,
    ],
)
def test_what_is_apart_wider_or_beside_the_axis_is_not(beside):
    assert extensions(image(body, beside)) == []


def test_what_another_shape_explains_is_not():
    other = lying(5, x=HALF + 0.02, radius=NECK, half=0.02)
    assert extensions(image(body, neck()), others=[other]) == []


def test_of_several_views_two_must_show_an_end():
    with_neck, without = image(body, neck()), image(body)
    assert extensions(with_neck, without, without) == []
    first, second, third = extensions(with_neck, without, with_neck)
    assert first is not None and second is None and third is not None
