import numpy as np
import pytest

from app.drawing import (
    draw_detections,
    draw_estimates,
    draw_left_out,
    draw_obstacles,
    draw_rejected,
    draw_surfaces,
)
from perception.detection.left_out import LeftOut
from perception.obstacles.obstacle import PerceivedObstacle
from perception.support.surface import SupportSurface
from perception.types import ObjectDetection, ObjectEstimate, RejectedObject, SupportPlane


def test_a_mesh_is_drawn_at_its_projection(overhead_frame, can_at):
    image = draw_estimates(overhead_frame, [can_at()])
    columns = np.nonzero((image[55:] != 100).any(axis=-1))[1]  # the label is above
    assert abs(columns.mean() - 79.5) < 2
    radius = 150 * 0.035 / 0.45  # the top of the can is 0.45 m from the camera
    assert np.ptp(columns) / 2 == pytest.approx(radius, abs=2)
    outside = draw_estimates(overhead_frame, [can_at(x=-3.0)])
    np.testing.assert_array_equal(outside, overhead_frame.rgb)


def test_near_objects_occlude_far_ones(overhead_frame, can_at):
    low = can_at(1)
    T = np.array(can_at().T_world_object)
    T[2, 3] = 0.2
    high = ObjectEstimate(1, "can", np.zeros(16), T, low.scale, low.mesh)
    both = draw_estimates(overhead_frame, [high, can_at(0)], 1.0)
    alone = draw_estimates(overhead_frame, [high], 1.0)
    np.testing.assert_array_equal(both[60, 80], alone[60, 80])


def test_masks_are_tinted_in_a_copy(overhead_frame):
    mask = np.zeros((120, 160), bool)
    mask[50:70, 70:90] = True
    image = draw_detections(overhead_frame, [ObjectDetection("mug", 0.8, mask, instance_id=3)])
    assert (image[60, 80] != 100).any() and (image[110, 10] == 100).all()
    assert (overhead_frame.rgb == 100).all()


def test_objects_that_are_left_out_are_outlined(overhead_frame):
    mask = np.zeros((120, 160), bool)
    mask[50:70, 70:90] = True
    found = [ObjectDetection("mug", 0.8, mask, instance_id=3)]
    image = draw_rejected(overhead_frame.rgb, found, [RejectedObject(3, "mug", "no fit")])
    assert (image[50, 72:88] != 100).any(axis=-1).all() and (image[60, 80] == 100).all()
    np.testing.assert_array_equal(draw_rejected(overhead_frame.rgb, found, []), overhead_frame.rgb)


def test_candidates_are_outlined_thinly_in_a_copy(overhead_frame):
    mask = np.zeros((120, 160), bool)
    mask[20:100, 30:130] = True
    image = draw_left_out(overhead_frame.rgb, [LeftOut(mask, "too far", "2.4 m")])
    assert (image[20, 32:128] != 100).any(axis=-1).all() and (image[23:40, 32:128] == 100).all()
    assert (image[50:70] != 100).any()  # the reason
    assert (overhead_frame.rgb == 100).all()


def test_the_outline_of_the_surface_is_drawn_where_it_projects_to(overhead_frame):
    square = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    z = float(np.median(overhead_frame.depth[overhead_frame.depth > 0]))
    T = overhead_frame.T_world_camera
    surface = SupportSurface(SupportPlane(offset=float(T[2, 3] - z)), square + T[:2, 3])
    image = draw_surfaces(overhead_frame.rgb, overhead_frame, [surface])
    rows, columns = np.nonzero((image != 100).any(axis=-1))
    side = 0.2 * overhead_frame.intrinsics.fx / z
    assert np.ptp(columns) == pytest.approx(side, abs=3) and np.ptp(rows) == pytest.approx(side, abs=3)
    assert len(columns) < 0.3 * side**2  # the sides alone
    behind = SupportSurface(SupportPlane(offset=float(T[2, 3] + 1)), square)
    np.testing.assert_array_equal(draw_surfaces(image, overhead_frame, [behind]), image)


def test_the_silhouette_of_a_thing_of_no_class_is_tinted_in_a_copy(overhead_frame, can_at):
    x, y = can_at().T_world_object[:2, 3]
    corners = np.array([(x + a, y + b, c) for a in (-0.05, 0.05) for b in (-0.05, 0.05) for c in (0.0, 0.1)])
    image = draw_obstacles(overhead_frame.rgb, overhead_frame, [PerceivedObstacle(0, (corners,), 500)])
    changed = (image != overhead_frame.rgb).any(axis=-1)
    side = 150 * 0.1 / (overhead_frame.T_world_camera[2, 3] - 0.1)  # of the top face in pixels
    assert changed[60, 80] and changed.sum() >= side**2 and (overhead_frame.rgb == 100).all()
    away = PerceivedObstacle(0, (corners + np.array((3.0, 0.0, 0.0)),), 500)
    np.testing.assert_array_equal(
        draw_obstacles(overhead_frame.rgb, overhead_frame, [away]), overhead_frame.rgb
    )
