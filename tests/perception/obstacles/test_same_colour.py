"""A bar that lies beside another thing, in its colour or another, in closed form."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.obstacles.same_colour import continued_in_colour, continued_in_one_view
from perception.types import ObjectEstimate, SupportPlane, TriangleMesh

VIEWS = [(45, 0), (45, 90), (45, 180), (45, 270), (80, 30)]  # elevation, azimuth [deg]
HALF, LENGTH = 0.025, 0.12  # of the bar's section, and along y [m]
RED, DARK_RED, BLUE = (150, 40, 40), (135, 36, 36), (40, 40, 150)
BAR = {"x": 0.0, "y": 0.0, "height": 2 * HALF, "half": (HALF, LENGTH / 2)}


def bar(resting="lying", category="bottle"):
    """The bar as it is estimated: its axis is z in its frame and y in the world."""
    shape = trimesh.creation.box((2 * HALF, 2 * HALF, LENGTH))
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    T[2, 3] = HALF
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    return ObjectEstimate(3, category, np.zeros(16), T, np.full(3, 0.1), mesh, resting=resting)


def beside(gap=0.002, length=0.08, x=None):
    """A thing at the side of the bar."""
    middle = HALF + gap + length / 2 if x is None else x
    return {"x": middle, "y": 0.0, "height": 0.04, "half": (length / 2, 0.025)}


def continued(scenes, thing, color, estimate=None, views=VIEWS):
    """The ids of what is continued, where the bar is red and the thing has a colour."""
    return continued_in_colour([estimate or bar()], images(scenes, thing, color, views), SupportPlane())


def images(scenes, thing, color, views, is_thing=lambda p: p[..., 0] > HALF + 0.001):
    frames = []
    for view in views:
        solids = [scenes.Solid(**BAR), scenes.Solid(**thing)]
        frame = scenes.render(solids, scenes.orbit((0, 0, 0.02), 0.5, *view), 0.001).frame
        T, k = frame.T_world_camera, frame.intrinsics
        v, u = np.mgrid[: k.height, : k.width]
        rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1)
        world = (rays * frame.depth[..., None]) @ T[:3, :3].T + T[:3, 3]
        rgb = np.where(is_thing(world)[..., None], color, RED).astype(np.uint8)
        frames.append(replace(frame, rgb=rgb))
    return frames


@pytest.mark.parametrize(("color", "expected"), [(RED, {3}), (DARK_RED, {3}), (BLUE, set())])
def test_an_object_is_continued_in_its_colour_alone(scenes, color, expected):
    assert continued(scenes, beside(), color) == expected


@pytest.mark.parametrize(
    "thing",
    [
        beside(gap=0.02),  # apart
        beside(length=0.02),  # as short as a cap
    ],
)
def test_what_is_apart_or_short_continues_nothing(scenes, thing):
    assert continued(scenes, thing, RED) == set()


def test_the_rest_of_an_object_in_the_line_of_its_axis_is_its_own(scenes):
    rest = {"x": 0.0, "y": LENGTH / 2 + 0.042, "height": 2 * HALF, "half": (HALF, 0.04)}
    assert continued(scenes, rest, RED) == set()


def test_other_objects_are_not_asked(scenes):
    assert continued(scenes, beside(), RED, bar(resting="upright")) == set()
    assert continued(scenes, beside(), RED, bar(category="mug")) == set()


def test_two_views_show_too_little(scenes):
    assert continued(scenes, beside(), RED, views=VIEWS[:2]) == set()


def in_one_view(scenes, thing, color, occupied=False):
    """Whether the first view shows that an upright mug is continued, where masks may be occupied."""
    frame = images(scenes, thing, color, VIEWS[:1])[0]
    mug = bar("upright", "mug")
    masks = np.full(frame.depth.shape, occupied)
    return continued_in_one_view([mug], [mug], frame, SupportPlane(), masks) == {3}


def test_one_view_shows_that_a_mug_is_the_shaft_of_a_shoe(scenes):
    assert in_one_view(scenes, beside(), RED)
    assert not in_one_view(scenes, beside(), BLUE)


def test_what_is_as_low_as_a_plate_continues_no_mug(scenes):
    assert not in_one_view(scenes, beside() | {"height": 0.028}, RED)


def test_what_may_be_another_object_continues_none(scenes):
    assert not in_one_view(scenes, beside(), RED, occupied=True)
