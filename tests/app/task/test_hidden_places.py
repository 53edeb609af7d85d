"""Places that images do not show: behind a wall, beyond the border, and not where objects are."""

import numpy as np
import pytest

from app.task.hidden_places import HEIGHT, NARROWEST, may_hide_an_object, revealing_viewpoints, widest_hidden
from manipulation.viewpoints import Viewpoint
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane

CAMERA = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
AREA = ((0.4, 0.6), (-0.3, -0.1))


def overhead(z=0.8, screen=None, x=0.5, base=0.0):
    """A view straight down on the table; a screen (radius [m], height [m]) is below the camera."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = x, -0.2, base + z
    depth = np.full((CAMERA.height, CAMERA.width), z, np.float32)
    if screen is not None:
        radius, height = screen
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
        at = np.hypot(u - CAMERA.cx, v - CAMERA.cy) / CAMERA.fx * (z - height)
        depth[at < radius] = z - height
    return RgbdFrame(0.0, np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA, T)


def test_an_empty_table_hides_nothing():
    assert widest_hidden([overhead()], [], AREA) == 0.0
    assert not may_hide_an_object([overhead()], [], AREA)


@pytest.mark.parametrize(("radius", "height"), [(0.03, 0.3), (0.02, 0.5)])
def test_the_shadow_of_a_screen_is_wider_than_the_screen(radius, height):
    shadow = radius * (0.8 - HEIGHT) / (0.8 - height)
    assert widest_hidden([overhead(screen=(radius, height))], [], AREA) == pytest.approx(shadow, abs=0.006)


def test_what_another_image_shows_is_not_hidden():
    behind = overhead(screen=(0.03, 0.3))
    assert may_hide_an_object([behind], [], AREA)
    assert not may_hide_an_object([behind, overhead()], [], AREA)


def test_beyond_the_border_of_the_image_all_is_hidden():
    aside = overhead(x=0.5 + 160 / 300 * (0.8 - HEIGHT))  # its border is in the middle of the area
    assert widest_hidden([aside], [], AREA) == pytest.approx(0.05, abs=0.006)


def test_where_nothing_is_measured_nothing_is_shown():
    blind = overhead()
    blind = RgbdFrame(0.0, blind.rgb, np.zeros_like(blind.depth), CAMERA, blind.T_world_camera)
    assert widest_hidden([blind], [], AREA) == pytest.approx(0.1, abs=0.006)


def test_nothing_else_stands_where_an_object_is(can_at):
    """What it hides of itself is no place for another one."""
    can = can_at(0, 0.5, -0.2)
    radius = float(np.linalg.norm(can.mesh.vertices[:, :2], axis=1).max())
    seen = overhead(screen=(radius, can.height))
    assert may_hide_an_object([seen], [], AREA)
    assert widest_hidden([seen], [can], AREA) < NARROWEST


def test_places_are_on_the_given_plane():
    """On a table 0.2 m higher, whose image is taken from as far above it."""
    frame = overhead(screen=(0.03, 0.3), base=0.2)
    raised = widest_hidden([frame], [], AREA, SupportPlane(offset=0.2))
    assert raised == pytest.approx(widest_hidden([overhead(screen=(0.03, 0.3))], [], AREA))
    assert widest_hidden([frame], [], AREA) > 0.09, "below that table"


def viewpoint(azimuth, x=0.5, elevation=60.0):
    return Viewpoint((x, -0.2, 0.0), np.deg2rad(azimuth), np.deg2rad(elevation), 0.6)


def test_what_is_hidden_behind_a_screen_is_looked_at_from_beside_it():
    """The screen, 5 cm wide and 25 cm above the table, hides the same place from straight above it."""
    behind = overhead(screen=(0.025, 0.25))
    above, aside, away = viewpoint(0, elevation=89.9), viewpoint(90, elevation=50), viewpoint(90, x=3.0)
    assert revealing_viewpoints([behind], [], AREA, [above, away, aside]) == [aside]
    assert revealing_viewpoints([behind], [], AREA, [above, away]) == []
    assert revealing_viewpoints([behind, overhead()], [], AREA, [aside]) == []
    assert revealing_viewpoints([behind], [], AREA, []) == []


def test_as_many_viewpoints_are_chosen_as_are_needed():
    """All of a wide area is beyond the border, and one viewpoint shows a half of it."""
    wide = ((0.1, 0.9), (-0.3, -0.1))
    blind = overhead(x=3.0)
    left, right, middle = viewpoint(0, 0.3, 89.9), viewpoint(0, 0.7, 89.9), viewpoint(0, 0.5, 89.9)
    assert revealing_viewpoints([blind], [], ((0.45, 0.55), (-0.25, -0.15)), [middle, left]) == [middle]
    assert set(revealing_viewpoints([blind], [], wide, [left, right])) == {left, right}


def test_an_object_on_the_place_needs_no_viewpoint(can_at):
    can = can_at(0, 0.5, -0.2)
    radius = float(np.linalg.norm(can.mesh.vertices[:, :2], axis=1).max())
    seen = overhead(screen=(radius, can.height))
    assert revealing_viewpoints([seen], [can], AREA, [viewpoint(90, elevation=50)]) == []
    assert revealing_viewpoints([seen], [], AREA, [viewpoint(90, elevation=30)]) != []
