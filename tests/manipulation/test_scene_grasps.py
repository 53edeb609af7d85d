"""Grasps of a scene without a robot: frames, obstacles, ranking and what is refused."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from manipulation.errors import ManipulationError
from manipulation.robot import GripperGeometry
from manipulation.scene_grasps import find_grasps
from perception.errors import InvalidInputError
from perception.geometry import invert, rigid, so3_exp
from perception.reconstruction import Reconstruction
from perception.types import ObjectDetection, SupportPlane

# A camera 0.7 m above the table that looks down at 50 degrees.
T_WORLD_CAMERA = rigid(so3_exp(np.array([np.deg2rad(-140.0), 0.0, 0.0])), np.array([0.45, -0.9, 0.7]))


@pytest.fixture(scope="module")
def can(shapes):
    return shapes.estimate(4, "can", shapes.can())


@pytest.fixture(scope="module")
def from_camera(can):
    """The can as an image without a pose shows it: everything in the camera frame."""
    T = invert(T_WORLD_CAMERA)
    normal = T[:3, 2]
    seen = replace(can, T_world_object=T @ can.T_world_object)
    return Reconstruction((seen,), SupportPlane(normal, float(normal @ T[:3, 3])), (), np.eye(4), posed=False)


def test_a_can_is_grasped_from_above_around_its_axis(can):
    grasps = find_grasps(can)
    assert grasps and [g.score for g in grasps] == sorted((g.score for g in grasps), reverse=True)
    for grasp in grasps:
        assert grasp.object_id == 4 and grasp.T_camera_tcp is None
        assert grasp.T_world_tcp[:2, 3] == pytest.approx((0.45, -0.3), abs=1e-3)
        assert grasp.T_world_tcp[:3, 2] == pytest.approx((0, 0, -1), abs=1e-6)
        assert 0.066 - 0.004 < grasp.opening <= 0.08
        assert grasp.pregrasp(0.07)[:3, 3] == pytest.approx(
            grasp.T_world_tcp[:3, 3] + 0.07 * grasp.retreat_world
        )
        np.testing.assert_array_equal(grasp.pregrasp()[:3, :3], grasp.T_world_tcp[:3, :3])


def test_grasps_do_not_depend_on_the_frame(can, from_camera):
    in_world, in_camera = find_grasps(can), find_grasps(from_camera)
    both = find_grasps(from_camera, T_world_camera=T_WORLD_CAMERA)
    assert len(in_world) == len(in_camera) == len(both)
    heights = sorted({round(float(g.T_world_tcp[2, 3]), 6) for g in in_world})
    assert sorted({round(float(g.T_world_tcp[2, 3]), 6) for g in both}) == heights
    for unposed, posed in zip(in_camera, both):
        np.testing.assert_allclose(unposed.T_world_tcp, unposed.T_camera_tcp, atol=1e-12)
        np.testing.assert_allclose(posed.T_world_tcp, T_WORLD_CAMERA @ posed.T_camera_tcp, atol=1e-12)
        assert posed.T_world_tcp[:3, 2] == pytest.approx((0, 0, -1), abs=1e-6)
        assert posed.retreat_world == pytest.approx((0, 0, 1), abs=1e-6)
        assert unposed.T_camera_tcp[:3, 2] == pytest.approx(
            invert(T_WORLD_CAMERA)[:3, :3] @ (0, 0, -1), abs=1e-6
        )


def test_a_raised_support_plane_is_respected(can):
    """The same can on a plane 0.3 m higher is grasped 0.3 m higher."""
    lifted = replace(can, T_world_object=rigid(np.eye(3), np.array([0, 0, 0.3])) @ can.T_world_object)
    scene = Reconstruction((lifted,), SupportPlane(offset=0.3))
    heights = [g.T_world_tcp[2, 3] - 0.3 for g in find_grasps(scene)]
    assert heights == pytest.approx([g.T_world_tcp[2, 3] for g in find_grasps(can)])


def test_an_object_on_another_surface_is_grasped_above_that_one(can):
    shelf = SupportPlane(offset=0.3)
    lifted = replace(can, T_world_object=rigid(np.eye(3), np.array([0, 0, 0.3])) @ can.T_world_object)
    seen = ObjectDetection("can", 0.9, np.ones((2, 2), bool), instance_id=4, support=1)
    scene = Reconstruction((lifted,), SupportPlane(), ((seen,),), planes=(SupportPlane(), shelf))
    expected = find_grasps(Reconstruction((lifted,), shelf))
    np.testing.assert_allclose([g.T_world_tcp for g in find_grasps(scene)], [g.T_world_tcp for g in expected])


def test_neighbours_block_the_grasps_on_their_side(shapes, can):
    beside = shapes.estimate(5, "can", shapes.can(), y=-0.3 + 0.066 + 0.008)
    free = find_grasps([can, beside], ids=[4])
    assert {g.object_id for g in free} == {4} and 0 < len(free) < len(find_grasps(can))
    for grasp in free:  # no finger fits into the 8 mm between them: the hand closes along x
        assert abs(grasp.T_world_tcp[1, 1]) < 0.8
    assert {g.object_id for g in find_grasps([can, beside])} == {4, 5}


def test_the_palm_must_clear_the_object(can):
    assert not find_grasps(can, gripper=GripperGeometry(palm=0.004))


def test_grippers_too_narrow_find_nothing(can):
    assert find_grasps(can, gripper=GripperGeometry(max_width=0.05)) == []


def test_lying_objects_are_reported_and_yield_nothing(can, caplog):
    lying = replace(
        can, T_world_object=can.T_world_object @ rigid(so3_exp(np.array([np.pi / 2, 0, 0])), np.zeros(3))
    )
    with caplog.at_level(logging.WARNING):
        assert find_grasps(lying) == []
    assert "can_4 lies on its side" in caplog.text


def test_unclear_frames_and_unknown_ids_are_refused(can):
    with pytest.raises(ManipulationError, match=r"^no object 9 in the scene; its ids are \[4\]$"):
        find_grasps(can, ids=[9])
    with pytest.raises(ManipulationError, match=r"^T_world_camera needs a Reconstruction"):
        find_grasps([can], T_world_camera=np.eye(4))
    with pytest.raises(InvalidInputError, match="in the world frame already"):
        find_grasps(Reconstruction((can,), SupportPlane()), T_world_camera=np.eye(4))
