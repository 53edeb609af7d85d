import numpy as np
import pytest

from app.ar.surroundings import APART, CELL, FARTHEST, HIGHEST, LOWEST, clutter, support_frame
from perception.errors import InvalidInputError
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane
from sim_assets.rendering.camera import look_at

LENS = CameraIntrinsics(160, 120, 150.0, 150.0, 75.0, 65.0)
ABOVE = look_at(np.array([0.0, 0.0, 0.5]), np.zeros(3))


def table_frame(T_world_camera, lift=0.0):
    """The image of a camera 0.5 m above an empty table, with a block of height ``lift`` in one corner."""
    depth = np.full((LENS.height, LENS.width), 0.5, np.float32)
    depth[:30, :40] -= lift
    rgb = np.full((LENS.height, LENS.width, 3), 180, np.uint8)
    return RgbdFrame(0.0, rgb, depth, LENS, T_world_camera)


def test_unknown_things_on_the_table_are_obstacles_and_objects_are_not(standing):
    estimate = standing("can", 0, (0.0, 0.0))
    frame = table_frame(ABOVE, lift=0.08)
    T = support_frame([estimate], SupportPlane())
    field = clutter([frame], [estimate], T)
    assert field.heights.max() == pytest.approx(0.08, abs=1e-3)
    middle = field.heights.shape[0] // 2
    assert field.heights[middle, middle] == 0
    row, column = np.nonzero(field.heights)
    x, y = (column - middle) * CELL + T[0, 3], (row - middle) * CELL + T[1, 3]
    local = (np.stack([x, y, np.full(len(x), 0.08)], axis=1) - ABOVE[:3, 3]) @ ABOVE[:3, :3]
    pixel = LENS.fx * local[:, :2] / local[:, 2:] + (LENS.cx, LENS.cy)
    assert (pixel < (46, 36)).all()


@pytest.mark.parametrize(
    ("lift", "kept"), [(0.8 * LOWEST, False), (1.2 * LOWEST, True), (HIGHEST + 0.02, False)]
)
def test_noise_and_overhanging_surfaces_are_no_obstacles(standing, lift, kept):
    estimate = standing("can", 0, (0.0, 0.0))
    field = clutter([table_frame(ABOVE, lift)], [estimate], support_frame([estimate], SupportPlane()))
    assert field.heights.any() == kept


def test_the_surroundings_of_an_object_are_left_out(standing):
    estimate = standing("can", 0, (0.0, 0.0))
    block = table_frame(ABOVE)
    everywhere = RgbdFrame(0.0, block.rgb, block.depth - np.float32(0.08), LENS, ABOVE)
    field = clutter([everywhere], [estimate], support_frame([estimate], SupportPlane()))
    rows, columns = np.nonzero(field.heights)
    distance = CELL * np.hypot(rows - field.heights.shape[0] // 2, columns - field.heights.shape[1] // 2)
    assert distance.min() == pytest.approx(estimate.radius + APART, abs=1.5 * CELL)


def test_the_support_frame_is_on_the_plane_below_the_objects(standing):
    T = support_frame([standing("can", 0, (0.1, 0.2)), standing("can", 1, (0.3, 0.2))], SupportPlane())
    np.testing.assert_allclose(T[:3, 3], (0.2, 0.2, 0.0), atol=1e-6)
    tilted = np.array([0.6, 0.0, 0.8])
    T = support_frame([standing("can")], SupportPlane(tilted, 0.1))
    np.testing.assert_allclose(T[:3, 2], tilted, atol=1e-6)
    assert T[:3, 3] @ tilted == pytest.approx(0.1)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)


def test_objects_that_are_kilometres_apart_are_refused(standing):
    objects = [standing("can", 0, (0.0, 0.0)), standing("can", 1, (2 * FARTHEST + 0.1, 0.0))]
    with pytest.raises(InvalidInputError, match=r"an object is 5\.\d+ m from the middle of the objects"):
        clutter([table_frame(ABOVE)], objects, support_frame(objects, SupportPlane()))
