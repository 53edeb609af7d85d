"""A bar that lies between two things, or in the middle of one, in closed form."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.obstacles.crossed import crossed
from perception.types import ObjectEstimate, SupportPlane, TriangleMesh

VIEWS = [(45, 0), (45, 90), (45, 180), (45, 270), (80, 30)]  # elevation, azimuth [deg]
HALF, LENGTH = 0.025, 0.16  # of the bar's section, and along y [m]
GREEN, DARK_GREEN, BLUE, GREY = (40, 120, 50), (36, 108, 45), (40, 50, 140), (180, 180, 180)


def bar(resting="lying", category="bottle"):
    """The bar as it is estimated: its axis is z in its frame and y in the world."""
    shape = trimesh.creation.cylinder(HALF, LENGTH, sections=24).subdivide().subdivide().subdivide()
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    T[2, 3] = HALF
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    return ObjectEstimate(3, category, np.zeros(16), T, np.full(3, 0.1), mesh, resting=resting)


def wing(side=1, y=0.0, gap=0.001, length=0.06, height=0.03, depth=0.04):
    """What lies at one side of the bar."""
    return {
        "x": side * (HALF + gap + length / 2), "y": y, "height": height, "half": (length / 2, depth / 2),
    }  # fmt: skip


def painted(scenes, solids, body, right, left):
    """Images of solids in the colours of the bar, and of what is at its right and at its left."""
    frames = []
    for view in VIEWS:
        frame = scenes.render(solids, scenes.orbit((0, 0, 0.02), 0.5, *view), 0.001).frame
        T, k = frame.T_world_camera, frame.intrinsics
        v, u = np.mgrid[: k.height, : k.width]
        rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1)
        x = ((rays * frame.depth[..., None]) @ T[0, :3] + T[0, 3])[..., None]
        rgb = np.where(x > HALF, right, np.where(x < -HALF, left, body)).astype(np.uint8)
        frames.append(replace(frame, rgb=rgb))
    return frames


def found(scenes, right, left, colors=(GREEN, GREEN), estimate=None):
    """The ids of what is crossed, where the bar is grey and the things at its sides have colours."""
    solids = [scenes.Solid(x=0.0, y=0.0, height=2 * HALF, half=(HALF, LENGTH / 2))]
    solids += [scenes.Solid(**thing) for thing in (right, left) if thing is not None]
    return crossed([estimate or bar()], painted(scenes, solids, GREY, *colors), SupportPlane())


@pytest.mark.parametrize(
    ("colors", "expected"), [((GREEN, GREEN), {3}), ((GREEN, DARK_GREEN), {3}), ((GREEN, BLUE), set())]
)
def test_what_is_of_one_colour_at_both_sides_crosses_an_object(scenes, colors, expected):
    assert found(scenes, wing(), wing(-1), colors) == expected


@pytest.mark.parametrize(
    ("right", "left"),
    [
        (wing(), None),  # at one side only
        (wing(y=0.05), wing(-1, y=-0.05)),  # at different places along the axis
        (wing(), wing(-1, length=0.025)),  # too short
        (wing(), wing(-1, gap=0.02)),  # apart
        (wing(height=0.025), wing(-1, height=0.055)),  # higher
    ],
    ids=["one-side", "shifted", "short", "apart", "higher"],
)
def test_things_at_the_sides_are_no_part_of_an_object(scenes, right, left):
    assert found(scenes, right, left) == set()


def test_other_objects_are_not_asked(scenes):
    assert found(scenes, wing(), wing(-1), estimate=bar(resting="upright")) == set()
    assert found(scenes, wing(), wing(-1), estimate=bar(category="mug")) == set()
