"""An estimate from fewer images is the start of a fit where all images agree with it."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.geometry import pose_from_yaw, upright_rotation
from perception.inference.observation import ObjectViews
from perception.inference.warm_start import find_warm_start, warm_start
from perception.rendering.pose import ObjectPose
from perception.types import ObjectEstimate, TriangleMesh


def views(can, azimuths=(0.0, 2.0, 4.0)):
    return ObjectViews(0, "can", 1.0, tuple(can.observations(azimuths)))


def estimate_near(can, offset=0.0, **changes):
    """An estimate whose box is that of the rendered can, moved along x [m]."""
    scale = float(can.pose.scale[0])
    shape = trimesh.creation.cylinder(0.55 * scale, 1.5 * scale, sections=24)
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    T = can.pose.T_world_object.copy()
    T[0, 3] += offset
    return replace(ObjectEstimate(7, "can", np.zeros(16), T, np.full(3, scale), mesh), **changes)


def test_the_estimate_at_the_measured_points_is_found(can):
    near, far = estimate_near(can), estimate_near(can, 0.06)
    assert find_warm_start(views(can), [far, near]) is near
    assert find_warm_start(views(can), [far]) is None
    assert find_warm_start(views(can), []) is None


def test_uncertain_estimates_are_not_used(can):
    near = estimate_near(can)
    assert find_warm_start(views(can), [near, estimate_near(can, 0.002)]) is None
    assert find_warm_start(views(can), [replace(near, status="not_converged")]) is not None
    assert find_warm_start(views(can), [replace(near, status="implausible")]) is None
    assert find_warm_start(views(can), [replace(near, resting="lying")]) is None


def mug(yaw):
    mesh = TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))
    return ObjectEstimate(
        1, "mug", np.arange(16.0), pose_from_yaw(yaw, np.array([0.1, 0.2, 0.3])), np.array([1.0, 2, 3]), mesh
    )


def hypotheses(*yaws):
    return [ObjectPose(upright_rotation(np.array([0.0, 0, 1]), y), np.zeros(3), np.ones(3)) for y in yaws]


def test_the_state_is_that_of_the_estimate():
    state = warm_start(mug(0.4), "mug", "upright", hypotheses(0.3, 2.0))
    assert state is not None and state.code.tolist() == list(range(16))
    np.testing.assert_allclose(state.pose.T_world_object, mug(0.4).T_world_object)
    assert state.pose.scale.tolist() == [1, 2, 3]


@pytest.mark.parametrize("yaw, used", [(0.3, True), (0.4, False), (2 * np.pi - 0.3, True), (np.pi, False)])
def test_a_mug_starts_anew_where_all_images_show_another_handle(yaw, used):
    assert (warm_start(mug(yaw), "mug", "upright", hypotheses(0.0, yaw)) is not None) == used


def test_other_classes_and_poses_start_anew():
    assert warm_start(None, "mug", "upright", hypotheses(0.0)) is None
    assert warm_start(mug(0.0), "can", "upright", hypotheses(0.0)) is None
    assert warm_start(mug(0.0), "mug", "upside-down", hypotheses(0.0)) is None
    bowl = replace(mug(3.0), category="bowl")  # without a direction
    assert warm_start(bowl, "bowl", "upright", hypotheses(0.0)) is not None
