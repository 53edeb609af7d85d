"""Parts that masks lack, on a depth image of a cylinder from above with something beside it."""

import numpy as np
import pytest
import trimesh

from perception.inference.lost_parts import with_lost_parts
from perception.types import (
    CameraIntrinsics,
    ObjectDetection,
    ObjectEstimate,
    RgbdFrame,
    SupportPlane,
    TriangleMesh,
)

HEIGHT, F = 0.6, 400.0
T_WORLD_CAMERA = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, HEIGHT], [0.0, 0.0, 0.0, 1.0]]
)
v, u = np.mgrid[:160, :200]
BODY = np.hypot(u - 99.5, v - 79.5) < 32  # 0.04 m at a height of 0.1 m


def estimate(id, x, radius=0.04, height=0.1):
    shape = trimesh.creation.cylinder(radius, height, sections=48)
    shape.apply_translation((x, 0, height / 2))
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    return ObjectEstimate(
        id, "mug", np.zeros(16), np.eye(4), np.full(3, 0.05), mesh, 0.9, resting="upside-down"
    )


def image_with(part, depth=0.52):
    """An image of the body and of an area at a depth [m], of which nothing else is known."""
    image = np.full((160, 200), HEIGHT, np.float32)
    image[part] = depth
    image[BODY] = 0.5
    camera = CameraIntrinsics(200, 160, F, F, 99.5, 79.5)
    return RgbdFrame(0.0, np.zeros((160, 200, 3), np.uint8), image, camera, T_WORLD_CAMERA)


def extensions(frames, others=()):
    """The extensions of the body's masks by view; None if there are none."""
    row = [ObjectDetection("mug", 0.9, BODY, instance_id=7)]
    known = {e.id: e for e in (estimate(7, 0.0), *others)}
    found = with_lost_parts(frames, [row] * len(frames), known, [7], SupportPlane())
    return None if not found else [None if mask is None else mask & ~BODY for mask in found[7]]


def lost(part, depth=0.52, others=()):
    """The mask's extension in a single view."""
    found = extensions([image_with(part, depth)], others)
    return None if found is None else found[0]


def strip(left, right):
    return (np.abs(v - 79.5) < 6) & (u > left) & (u < right)


def test_what_no_shape_explains_beside_a_mask_belongs_to_it():
    extension = lost(strip(131, 152))
    expected = strip(131, 152) & ~BODY
    assert (extension & expected).sum() > 0.7 * expected.sum() and not (extension & ~expected).any()


@pytest.mark.parametrize(
    "case",
    [
        {"part": strip(141, 160)},  # apart from the mask
        {"part": strip(131, 152), "depth": 0.596},  # on the table
        {"part": strip(131, 152), "depth": 0.42},  # far above
        {"part": (v > 5) & (u > 131)},  # larger than a part
        {"part": strip(131, 134)},  # noise along the outline
        {"part": strip(131, 152), "others": (estimate(8, 0.06, 0.021, 0.08),)},  # another object
    ],
)
def test_what_is_apart_too_large_or_known_does_not(case):
    assert lost(**case) is None


def test_views_must_agree_on_a_part():
    """Two views show a part on the right; one of these, and a third, something on the left."""
    right, left = strip(131, 152), strip(47, 68)
    frames = [image_with(right | left), image_with(right), image_with(right), image_with(left)]
    found = extensions(frames)
    for extension in found[:3]:
        assert (extension & right).any() and not (extension & left).any()
    assert found[3] is None


def test_of_two_views_that_show_different_parts_none_counts():
    assert extensions([image_with(strip(131, 152)), image_with(strip(47, 68))]) is None
    both = extensions([image_with(strip(131, 152))] * 2)
    assert all(extension.any() for extension in both)


def test_a_thing_that_touches_a_part_is_none():
    """A part of 0.03 m meets a thing, with a mask of its own, at its far end."""
    part, thing = strip(131, 152), (np.abs(v - 79.5) < 30) & (u >= 152) & (u < 180)
    row = [ObjectDetection("mug", 0.9, BODY, instance_id=7), ObjectDetection("mug", 0.9, thing)]
    frame = image_with(part | thing)
    found = with_lost_parts([frame], [row], {7: estimate(7, 0.0)}, [7], SupportPlane())
    extension = found[7][0] & ~BODY
    assert (extension & part).sum() > 0.7 * (part & ~BODY).sum() and not (extension & thing).any()
