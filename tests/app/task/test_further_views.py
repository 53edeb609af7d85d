"""A further image is taken for objects at risk, and for objects that were rejected by little."""

from dataclasses import replace

import numpy as np
import pytest

from app.task.further_views import BORDER, cut_by_borders, most_useful_viewpoint, things_never_whole
from manipulation.planner import ManipulationConfig
from manipulation.viewpoints import further_viewpoints, scan_viewpoints
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import CameraIntrinsics, RejectedObject, RgbdFrame
from sim_assets.robots import panda

LEFT = further_viewpoints(2)


@pytest.fixture
def choose(can_at):
    def viewpoint(score=0.95, sigma=0.001, rejected=(), tilt=0.0):
        can = can_at(1)
        T = can.T_world_object.copy()
        T[:3, :3] = [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
        deviations = np.full(len(can.mesh.vertices), sigma)
        seen = replace(can, score=score, surface_sigma=deviations, T_world_object=T)
        return most_useful_viewpoint([seen], rejected, LEFT, panda().description, ManipulationConfig())

    return viewpoint


def test_sure_objects_need_no_further_image(choose):
    assert choose() is None


@pytest.mark.parametrize("doubt", [{"score": 0.6}, {"sigma": 0.03}, {"tilt": 1.0}])
def test_doubtful_class_uncertain_grasps_and_impossible_poses_are_worth_one(choose, doubt):
    assert choose(**doubt) in LEFT


@pytest.mark.parametrize("score, found", [(0.15, LEFT[0]), (0.05, None)])
def test_a_rejected_object_is_looked_at_again_if_it_may_be_one(choose, score, found):
    assert choose(rejected=[RejectedObject(2, "mug", "seen from one side", score)]) is found


def test_viewpoints_are_those_that_the_scan_lacks():
    assert set(LEFT) | set(scan_viewpoints(2)) == set(scan_viewpoints(6)) and len(LEFT) == 4
    assert further_viewpoints(6) == () and further_viewpoints(1)[0] in scan_viewpoints(2)


CAMERA = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)


def seen_from(x):
    """An image from above (x, -0.2), 0.6 m over the table; what stands there is in its middle."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = x, -0.2, 0.6
    depth = np.ones((CAMERA.height, CAMERA.width), np.float32)
    return RgbdFrame(0.0, np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA, T)


def test_what_fewer_than_two_images_show_whole_is_cut(can_at):
    """A can of 0.1 m height and 35 mm radius: its top is 0.5 m below the camera."""
    can = can_at(0, 0.4)
    whole = 0.5 * (160 - BORDER) / 300 - 0.035  # [m] from the middle of the image
    inside, outside = seen_from(0.4 + whole - 0.005), seen_from(0.4 + whole + 0.01)
    assert cut_by_borders([can], [inside, seen_from(0.4), outside]) == []
    assert cut_by_borders([can], [inside, outside, outside]) == [pytest.approx((0.4, -0.2))]
    assert cut_by_borders([can], [inside]) == [] and len(cut_by_borders([can], [outside])) == 1


def test_what_is_behind_the_camera_is_not_seen(can_at):
    frame = seen_from(0.4)
    T = frame.T_world_camera.copy()
    T[2, 3] = -0.5
    assert len(cut_by_borders([can_at(0, 0.4)], [replace(frame, T_world_camera=T)] * 2)) == 1


def test_a_thing_that_one_image_shows_whole_is_known():
    """A block of 0.1 m width: half of it is beyond the border of an image of the table beside it."""
    corners = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    block = PerceivedObstacle(
        1, (0.05 * corners + (0.39, -0.2, 0.05), 0.05 * corners + (0.44, -0.2, 0.05)), 9
    )
    inside, half = seen_from(0.4), seen_from(0.4 + 0.55 * 160 / 300)
    assert things_never_whole([block], [half, inside]) == []
    assert things_never_whole([block], [half, half]) == [pytest.approx((0.415, -0.2))]
