"""A cylinder with a bar beside it, in closed form: the bar hangs, stands, lies on top, or touches another."""

import numpy as np
import pytest
import trimesh

from perception.obstacles.attached import carriers_of_parts
from perception.types import ObjectEstimate, SupportPlane, TriangleMesh

VIEWS = [(45, 0), (45, 90), (45, 180), (45, 270), (88, 0)]  # elevation, azimuth [deg]
RADIUS, HEIGHT = 0.035, 0.12


def estimate(id, x=0.0):
    shape = trimesh.creation.cylinder(RADIUS, HEIGHT, sections=48)
    T = np.eye(4)
    T[:3, 3] = x, 0, HEIGHT / 2
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    return ObjectEstimate(id, "can", np.zeros(16), T, np.full(3, 0.1), mesh)


def carriers(scenes, bar=None, objects=(0.0,), views=VIEWS, noise=0.0):
    """The ids of the cylinders, at these x [m], that carry something."""
    solids = [scenes.Solid(x, 0.0, HEIGHT, radius=RADIUS) for x in objects]
    solids += [scenes.Solid(**bar)] if bar else []
    frames = [scenes.render(solids, scenes.orbit((0, 0, 0.05), 0.55, *view), noise).frame for view in views]
    return carriers_of_parts([estimate(k, x) for k, x in enumerate(objects)], frames, SupportPlane())


def bar(x=0.065, length=0.06, bottom=0.06, thickness=0.02, width=0.02):
    return {"x": x, "y": 0.0, "height": thickness, "half": (length / 2, width / 2), "bottom": bottom}


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_what_hangs_beside_an_object_is_attached_to_it(scenes, noise):
    assert carriers(scenes, bar(), noise=noise) == {0}


def test_a_bare_object_carries_nothing(scenes):
    assert carriers(scenes, noise=0.002) == set()


@pytest.mark.parametrize(
    "thing",
    [
        bar(bottom=0.0, thickness=0.08),  # stands on the table
        bar(x=0.0, length=0.16, width=0.03, bottom=HEIGHT),  # lies across the top
        bar(x=0.05, length=0.03),  # reaches less than a handle may
        bar(x=0.095),  # apart from it
    ],
)
def test_what_something_else_carries_is_not_attached(scenes, thing):
    assert carriers(scenes, thing) == set()


def test_what_two_objects_carry_is_attached_to_neither(scenes):
    between = bar(x=0.07, length=0.07)
    assert carriers(scenes, between, objects=(0.0, 0.14)) == set()
    assert carriers(scenes, between, objects=(0.0, 0.18)) == {0}


def test_two_views_show_too_little_below(scenes):
    assert carriers(scenes, bar(), views=VIEWS[:2]) == set()
    assert carriers(scenes, bar(), objects=()) == set()
