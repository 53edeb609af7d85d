import numpy as np
import pytest

from app.drawing import draw_detections, draw_estimates, draw_rejected
from perception.types import ObjectDetection, ObjectEstimate, RejectedObject


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
