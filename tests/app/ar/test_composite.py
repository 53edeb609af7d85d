import numpy as np
import pytest

from app.ar.composite import DARKEST, TOLERANCE, Backdrop, composite, shadow_of, visible_toys
from perception.types import CameraIntrinsics, RgbdFrame
from sim_assets.cell.drop_world import DropRendering
from sim_assets.rendering.camera import look_at

LENS = CameraIntrinsics(160, 120, 150.0, 150.0, 75.0, 65.0)
ABOVE = look_at(np.array([0.0, 0.0, 0.5]), np.zeros(3))


def table_frame(T_world_camera):
    """The image of a camera 0.5 m above an empty table."""
    depth = np.full((LENS.height, LENS.width), 0.5, np.float32)
    rgb = np.full((LENS.height, LENS.width, 3), 180, np.uint8)
    return RgbdFrame(0.0, rgb, depth, LENS, T_world_camera)


def test_measured_depth_hides_what_lies_behind_it():
    toys = np.zeros((LENS.height, LENS.width), bool)
    toys[40:80, 60:100] = True
    white = np.full((LENS.height, LENS.width, 3), 255, np.uint8)
    red = np.where(toys[..., None], np.array([255, 0, 0], np.uint8), white)
    near, far = np.full(toys.shape, 0.4, np.float32), np.full(toys.shape, 0.6, np.float32)
    frame = table_frame(ABOVE)
    backdrop = Backdrop.of(frame, DropRendering(white, far, np.zeros_like(toys)))
    assert (visible_toys(backdrop, DropRendering(red, near, toys)) == toys).all()
    assert not visible_toys(backdrop, DropRendering(red, far, toys)).any()
    shown, hidden = (composite(backdrop, DropRendering(red, depth, toys)) for depth in (near, far))
    np.testing.assert_allclose(shown[60, 80], (255, 0, 0), atol=2)
    np.testing.assert_array_equal(hidden[60, 80], frame.rgb[60, 80])
    np.testing.assert_array_equal(shown[5, 5], frame.rgb[5, 5])


def grey(level, toys, depth=0.6):
    color = np.full((*toys.shape, 3), level, np.uint8)
    return DropRendering(color, np.full(toys.shape, depth, np.float32), toys)


@pytest.mark.parametrize(("behind", "visible"), [(0.9 * TOLERANCE, True), (1.1 * TOLERANCE, False)])
def test_a_toy_may_lie_behind_the_measurement_by_its_noise(behind, visible):
    toys = np.zeros((LENS.height, LENS.width), bool)
    toys[40:80, 60:100] = True
    backdrop = Backdrop.of(table_frame(ABOVE), grey(255, np.zeros_like(toys)))
    assert visible_toys(backdrop, grey(0, toys, 0.5 + behind)).any() == visible


def test_toys_are_visible_where_nothing_was_measured():
    toys = np.ones((LENS.height, LENS.width), bool)
    frame = table_frame(ABOVE)
    hole = RgbdFrame(0.0, frame.rgb, np.zeros_like(frame.depth), LENS, ABOVE)
    assert visible_toys(Backdrop.of(hole, grey(255, ~toys)), grey(0, toys, 9.0)).all()


def test_a_shadow_is_the_ratio_of_the_renderings_with_a_lower_bound():
    none = np.zeros((LENS.height, LENS.width), bool)
    backdrop = Backdrop.of(table_frame(ABOVE), grey(199, none))
    np.testing.assert_allclose(shadow_of(backdrop, grey(199, none)), 1.0, atol=1e-6)
    np.testing.assert_allclose(shadow_of(backdrop, grey(149, none)), 0.75, atol=1e-6)
    np.testing.assert_allclose(shadow_of(backdrop, grey(9, none)), DARKEST, atol=1e-6)
    np.testing.assert_allclose(shadow_of(backdrop, grey(255, none)), 1.0, atol=1e-6)  # never brighter
    assert composite(backdrop, grey(149, none))[60, 80].tolist() == [135, 135, 135]  # 0.75 of 180
