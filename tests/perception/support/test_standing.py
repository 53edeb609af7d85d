"""Where objects stand in scenes in closed form: on a table, on a box, beside, above and behind things."""

import numpy as np
import pytest

from perception.support.standing import MeasuredObject, misplacement, support_of
from perception.support.surface import SupportSurface
from perception.types import SupportPlane

TABLE = 0.5
SQUARE = np.array([[-0.3, -0.2], [0.3, -0.2], [0.3, 0.2], [-0.3, 0.2]])
SURFACE = SupportSurface(SupportPlane(offset=TABLE), SQUARE)
EYE = (0, -0.8, 0.95)


def seen(scenes, solid, *others, eye=EYE, noise=0.001):
    """The measured object of the first solid on a table of 60 by 40 centimetres above a floor."""
    table = scenes.Solid(0, 0, 0.02, half=(0.3, 0.2), bottom=TABLE - 0.02)
    scene = scenes.render([solid, *others, table], scenes.look_at(eye, (0, 0, TABLE)), noise, (640, 480))
    measured = MeasuredObject.of(scene.frame, scene.instances == 0)
    assert measured is not None
    return measured


def can(scenes, x=0.0, y=0.0, bottom=TABLE, height=0.1):
    return scenes.Solid(x, y, height, radius=0.035, bottom=bottom)


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.25, -0.15), (-0.26, 0.16)])
def test_an_object_on_the_table_has_no_fault(scenes, x, y):
    assert misplacement(seen(scenes, can(scenes, x, y)), SURFACE) is None


def reason(found):
    return None if found is None else found.reason


@pytest.mark.parametrize(
    ("solid", "expected"),
    [
        ({"x": 0.42, "bottom": 0.0, "height": 0.6}, "beyond the edge of the support surface"),
        ({"x": 0.0, "y": 0.4, "bottom": 0.2, "height": 0.5}, "beyond the edge of the support surface"),
        ({"bottom": TABLE + 0.05}, "does not touch the support surface"),
        ({"x": 0.1, "bottom": TABLE + 0.01}, None),
        ({"x": 0.1, "height": 0.006}, "does not rise above the support surface"),
        ({"x": 0.1, "height": 0.025}, None),
    ],
)
def test_faults_are_named(scenes, solid, expected):
    assert reason(misplacement(seen(scenes, can(scenes, **solid)), SURFACE)) == expected


def test_what_reaches_below_an_unlimited_surface_does_not_stand_on_it(scenes):
    beside = seen(scenes, can(scenes, x=0.35, y=-0.1, bottom=0.2, height=0.35))
    fault = misplacement(beside, SupportSurface(SupportPlane(offset=TABLE)))
    assert reason(fault) == "reaches below the support surface" and fault.detail.endswith("cm")


def test_a_hidden_base_is_no_fault(scenes):
    front = scenes.Solid(0, -0.08, 0.08, half=(0.1, 0.02), bottom=TABLE)
    behind = seen(scenes, can(scenes, height=0.15), front)
    assert SURFACE.plane.height_above(behind.points).min() > 0.03  # the base is not seen
    assert misplacement(behind, SURFACE) is None


def test_an_unmeasured_base_is_no_fault(scenes):
    whole = seen(scenes, can(scenes))
    depth = np.array(whole.frame.depth)
    rows = np.nonzero(whole.mask.any(1))[0]
    depth[rows[-1] - 35 : rows[-1] + 8] = 0
    frame = type(whole.frame)(0.0, whole.frame.rgb, depth, whole.frame.intrinsics, whole.frame.T_world_camera)
    partial = MeasuredObject.of(frame, whole.mask)
    assert SURFACE.plane.height_above(partial.points).min() > 0.03
    assert misplacement(partial, SURFACE) is None


def test_a_view_from_above_leaves_open_whether_an_object_touches(scenes):
    tall = seen(scenes, can(scenes, height=0.2), eye=(0, -0.001, 1.4))
    assert np.percentile(SURFACE.plane.height_above(tall.points), 5) > 0.1
    assert misplacement(tall, SURFACE) is None


def test_objects_beyond_the_working_distance_are_left_out(scenes):
    far = seen(scenes, can(scenes), eye=(0, -1.9, 1.6))
    fault = misplacement(far, SURFACE)
    assert reason(fault) == "too far" and fault.detail == f"{far.distance:.1f} m; searched up to 2 m"


def test_an_object_is_assigned_to_the_surface_below_it(scenes):
    box = scenes.Solid(0, 0, 0.12, half=(0.1, 0.08), bottom=TABLE)
    lid = SupportSurface(SupportPlane(offset=TABLE + 0.12), SQUARE * (1 / 3, 0.4))
    surfaces = (SURFACE, lid)
    assert support_of(seen(scenes, can(scenes, bottom=TABLE + 0.12), box), surfaces) == 1
    assert support_of(seen(scenes, can(scenes, x=0.2), box), surfaces) == 0
    assert support_of(seen(scenes, box), surfaces) == 0
    floor = SupportSurface(SupportPlane(offset=0.0))
    assert support_of(seen(scenes, can(scenes)), (SURFACE, floor)) == 0
    assert (
        support_of(seen(scenes, can(scenes, x=0.6, bottom=0.0), eye=(0.3, -0.9, 1.3)), (SURFACE, floor)) == 1
    )


def test_a_mask_without_depth_is_not_measured(scenes):
    whole = seen(scenes, can(scenes))
    frame = type(whole.frame)(0.0, whole.frame.rgb, 0 * whole.frame.depth, whole.frame.intrinsics)
    assert MeasuredObject.of(frame, whole.mask) is None


def test_pixels_of_the_background_at_the_border_of_a_mask_are_not_the_objects(scenes):
    whole = seen(scenes, can(scenes))
    wide = np.zeros_like(whole.mask)
    v, u = np.nonzero(whole.mask)
    for dv, du in ((-2, 0), (2, 0), (0, -2), (0, 2)):
        wide[v + dv, u + du] = True
    points = MeasuredObject.of(whole.frame, wide | whole.mask).points
    assert np.hypot(points[:, 0], points[:, 1]).max() < 0.045
