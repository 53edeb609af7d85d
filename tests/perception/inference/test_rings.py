"""What is seen through a mug: its floor, the support, or nothing."""

from dataclasses import replace

import numpy as np
import pytest

from perception.inference.observation import ObjectObservation
from perception.inference.rings import is_ring
from perception.types import SupportPlane
from tests.perception.inference.test_handle import CAMERA, HEIGHT, RADIUS, mug, seen_from_above

__all__ = ["mug"]


def seen(floor, hole=0.5 * RADIUS, noise=0.0, raised=0.0):
    """A round wall seen from above, and what is at a height [m] in its hole; the mask is the wall alone."""
    frame = seen_from_above()
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    depth = frame.depth.astype(float) - raised
    mask = np.zeros(depth.shape, bool)
    for top, radius in ((HEIGHT, RADIUS), (floor, hole)):
        z = 0.5 - raised - top
        inside = np.hypot((u - CAMERA.cx) * z / CAMERA.fx, (v - CAMERA.cy) * z / CAMERA.fy) < radius
        depth[inside], mask = z, inside & ~mask if radius == RADIUS else mask & ~inside
    rng = np.random.default_rng(0)
    frame = replace(frame, depth=(depth + rng.normal(0, noise, depth.shape)).astype(np.float32))
    return ObjectObservation(frame, mask)


@pytest.mark.parametrize(("floor", "expected"), [(0.0, True), (0.003, False), (0.03, False)])
def test_a_mug_through_which_its_support_is_seen_is_a_ring(mug, floor, expected):
    views = [seen(floor, noise=0.002)] * 2
    assert is_ring(mug, views, SupportPlane()) is expected


def test_what_it_stands_on_may_be_another_object(mug):
    T = mug.T_world_object.copy()
    T[2, 3] += 0.1
    raised = replace(mug, T_world_object=T)
    views = [seen(0.0, raised=0.1)] * 2
    assert is_ring(raised, views, SupportPlane(offset=0.1)) and not is_ring(raised, views, SupportPlane())


def test_a_hole_that_is_hardly_seen_tells_nothing(mug):
    view = seen(0.0)
    depth = view.frame.depth.copy()
    v, u = np.nonzero(depth > 0.499)
    inside = np.hypot(u - CAMERA.cx, v - CAMERA.cy) < 20
    depth[v[inside], u[inside]] = 0.0
    depth[59:62, 78:82] = 0.5
    assert not is_ring(mug, [replace(view, frame=replace(view.frame, depth=depth))], SupportPlane())
    assert not is_ring(mug, [], SupportPlane())


@pytest.mark.parametrize("change", [{"category": "bowl"}, {"category": "can"}, {"resting": "upside-down"}])
def test_other_classes_and_poses_are_not_asked(mug, change):
    """A bowl of steel has a floor of a millimetre."""
    assert not is_ring(replace(mug, **change), [seen(0.0)] * 2, SupportPlane())


def test_the_middle_of_the_mug_is_looked_at(mug):
    """Beside it the table is seen as well."""
    T = mug.T_world_object.copy()
    T[0, 3] += 0.75 * RADIUS
    assert not is_ring(replace(mug, T_world_object=T), [seen(0.0)] * 2, SupportPlane())
