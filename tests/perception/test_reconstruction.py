"""Reconstructions without a camera pose, moved into the world once it is known."""

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.geometry import rigid, so3_exp
from perception.inference.uncertainty import surface_deviation
from perception.reconstruction import Reconstruction, transformed_estimate
from perception.types import ObjectDetection, ObjectEstimate, SupportPlane, TriangleMesh

T = rigid(so3_exp(np.array([0.4, -1.1, 0.7])), np.array([0.3, -0.2, 0.9]))
MESH = TriangleMesh(
    np.array([[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1], [0, 0, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
)


def estimate():
    root = np.random.default_rng(0).normal(0, 0.01, (25, 25))
    pose = rigid(so3_exp(np.array([0.2, 0.1, -0.5])), np.array([0.05, 0.1, 0.6]))
    return ObjectEstimate(3, "can", np.zeros(16), pose, np.full(3, 0.1), MESH, covariance=root @ root.T)


def test_an_estimate_moves_rigidly():
    moved = transformed_estimate(estimate(), T)
    np.testing.assert_allclose(moved.mesh_world.vertices, estimate().mesh_world.transformed(T).vertices)
    assert moved.mesh is estimate().mesh or np.array_equal(moved.mesh.vertices, MESH.vertices)


def test_surface_deviations_do_not_depend_on_the_frame():
    before, moved = estimate(), transformed_estimate(estimate(), T)
    grid = np.random.default_rng(1).uniform(0, 1, (32, 32, 32))
    jacobian = np.random.default_rng(2).normal(0, 1, (32, 32, 32, 16))
    np.testing.assert_allclose(
        surface_deviation(moved, moved.covariance, grid, jacobian),
        surface_deviation(before, before.covariance, grid, jacobian),
    )


def test_translation_covariance_is_rotated_into_the_new_axes():
    covariance = np.zeros((25, 25))
    covariance[19, 19] = 4e-6  # along x alone
    item = ObjectEstimate(1, "can", np.zeros(16), np.eye(4), np.ones(3), MESH, covariance=covariance)
    turned = transformed_estimate(item, rigid(so3_exp(np.array([0, 0, np.pi / 2])), np.zeros(3))).covariance
    assert turned[20, 20] == pytest.approx(4e-6) and turned[19, 19] == pytest.approx(0.0, abs=1e-12)


def test_in_world_moves_objects_and_plane_together():
    plane = SupportPlane(np.array([0.0, -0.8, -0.6]), -0.44)
    seen = ObjectDetection(
        "mug", 0.9, np.ones((2, 2), bool), yaw_probabilities=np.full(4, 0.25), instance_id=3
    )
    scene = Reconstruction((estimate(),), plane, ((seen,),), np.eye(4), posed=False)
    moved = scene.in_world(T)
    np.testing.assert_array_equal(moved.T_world_camera, T)
    assert moved.posed and moved.detections[0][0].yaw_probabilities.size == 0
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(
        moved.plane.height_above(points @ T[:3, :3].T + T[:3, 3]), plane.height_above(points)
    )
    np.testing.assert_allclose(moved.objects[0].T_world_object, T @ estimate().T_world_object)
    with pytest.raises(InvalidInputError, match=r"^the reconstruction is in the world frame already"):
        moved.in_world(T)
    with pytest.raises(InvalidInputError, match="T_world_camera must be a rigid motion"):
        scene.in_world(np.diag([2.0, 2, 2, 1]))


def test_an_object_has_the_plane_that_its_detection_names():
    main, shelf = SupportPlane(), SupportPlane(offset=0.3)
    seen = ObjectDetection("can", 0.9, np.ones((2, 2), bool), instance_id=3, support=1)
    scene = Reconstruction((estimate(),), main, ((), (seen,)), np.eye(4), False, planes=(main, shelf))
    assert scene.plane_of(3) is shelf and scene.plane_of(7) is main
    assert Reconstruction((estimate(),), main, ((seen,),)).plane_of(3) is main
    moved = scene.in_world(rigid(np.eye(3), np.array([0.0, 0.0, 0.5])))
    assert (moved.plane_of(3).offset, moved.plane.offset) == pytest.approx((0.8, 0.5))
