"""A mug of two cylinders, with and without its handle in the images, alone and beside a thing of no class."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.obstacles.handleless import mugs_without_handle
from perception.types import ObjectEstimate, SupportPlane, TriangleMesh

VIEWS = [(45, 0), (45, 90), (45, 180), (45, 270), (88, 0)]  # elevation, azimuth [deg]
RADIUS, HEIGHT = 0.04, 0.09


def mug(handle=0.03, width=0.012, n_views=5):
    """A closed cylinder with a block of a length [m] along +x as its handle, at the origin."""
    body = trimesh.creation.cylinder(RADIUS, HEIGHT, sections=48)
    block = trimesh.creation.box((handle, width, 0.05))
    block.apply_translation((RADIUS + handle / 2, 0, 0))
    shape = trimesh.util.concatenate([body, block] if handle else [body])
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    T = np.eye(4)
    T[2, 3] = HEIGHT / 2
    made = ObjectEstimate(3, "mug", np.zeros(16), T, np.full(3, 0.1), mesh)
    return replace(made, n_views=n_views)


def images(scenes, handle=False, toe=0.0):
    """Images of the body with its handle, and a block of a width [m] that touches it on the other side."""
    solids = [scenes.Solid(0.0, 0.0, HEIGHT, radius=RADIUS)]
    if handle:
        solids.append(scenes.Solid(0.055, 0.0, 0.05, half=(0.015, 0.006), bottom=0.02))
    if toe:
        solids.append(scenes.Solid(-0.06, 0.0, 0.07, half=(0.045, toe / 2)))
    return [scenes.render(solids, scenes.orbit((0, 0, 0.05), 0.55, *view), 0.001).frame for view in VIEWS]


def found(scenes, estimate, **shown):
    return mugs_without_handle([estimate], images(scenes, **shown), SupportPlane())


def test_the_shaft_of_a_shoe_is_no_mug(scenes):
    assert found(scenes, mug(), toe=0.1) == {3}


@pytest.mark.parametrize("shown", [{}, {"handle": True}, {"handle": True, "toe": 0.1}, {"toe": 0.03}])
def test_a_mug_with_its_handle_or_with_little_beside_it_is_one(scenes, shown):
    assert found(scenes, mug(), **shown) == set()


def test_few_views_and_other_poses_show_too_little(scenes):
    assert found(scenes, mug(n_views=3), toe=0.1) == set()
    assert found(scenes, replace(mug(), resting="lying"), toe=0.1) == set()
    assert found(scenes, mug(handle=0.0), toe=0.1) == set()


def test_a_toe_that_the_shape_takes_for_a_handle_is_too_large(scenes):
    large = mug(handle=0.09, width=0.05)
    assert found(scenes, large, handle=True) == {3}
    assert found(scenes, replace(large, resting="lying"), handle=True) == {3}
    assert found(scenes, replace(large, category="can"), handle=True) == set()
    assert mugs_without_handle([], [], SupportPlane()) == set()
