"""Fits of poses to depth, and the pixels that speak for and against a pose."""

import numpy as np
import pytest

from perception.inference.pose_search import PoseSearch, RefitConfig
from perception.rendering.pose import ObjectPose
from perception.types import ObjectEstimate, SupportPlane


def _search(table, estimate, others=()) -> PoseSearch:
    frames = [table.frame(table.camera(0.3), np.random.default_rng(5))[0]]
    return PoseSearch(estimate, frames, table.pose.T_world_object, others, SupportPlane(), RefitConfig())


def test_pixels_of_another_object_do_not_speak_for_a_pose(mug, estimate) -> None:
    search = _search(mug, estimate)
    pose = ObjectPose.of(mug.pose.T_world_object, search.scale)
    agree, through = search.evidence(pose)
    assert search.gain(pose, alone=True) == pytest.approx(agree - through, rel=0.01)
    search.explained = np.full_like(search.measured, 0.004)
    assert search.gain(pose, alone=True) == -through, "although it explains them as well as the other does"


def test_depth_that_another_object_explains_better_is_not_evidence(mug, estimate) -> None:
    search = _search(mug, estimate)
    agree, behind = search.evidence(mug.pose)
    assert agree > 500 and search._evaluate(mug.pose, 0.03).weights[:-2].any()
    search.explained = np.full_like(search.measured, -1.0)
    assert search.evidence(mug.pose) == (0.0, behind)
    assert not search._evaluate(mug.pose, 0.03).weights[:-2].any()


def test_a_pose_behind_what_is_seen_gains_less_than_the_true_one(mug, estimate) -> None:
    """Most pixels measure depth in front of a pose behind the object; only their number tells it."""
    search = _search(mug, estimate)
    pose = ObjectPose.of(mug.pose.T_world_object, search.scale)
    behind = pose.moved(np.concatenate([np.zeros(3), 0.012 * search.cameras[0][:3, 2], np.zeros(3)]))
    agree, through = search.evidence(pose)
    assert search.gain(pose) == agree - through
    assert search.share(behind) > 0.5 * search.share(pose)
    assert search.gain(behind) < 0.2 * search.gain(pose)


def test_the_nearest_of_several_objects_explains_the_depth(mug, estimate) -> None:
    neighbours = []
    for offset in (0.01, 0.05):
        pose = mug.pose.moved(np.array([0, 0, 0, offset, 0, 0, 0, 0, 0]))
        neighbours.append(
            ObjectEstimate(1, "mug", mug.code, pose.T_world_object, mug.pose.scale, estimate.mesh)
        )
    near, far = (_search(mug, estimate, [other]).explained for other in neighbours)
    assert (near < far).any() and np.isinf(np.maximum(near, far)).any()
    np.testing.assert_array_equal(_search(mug, estimate, neighbours).explained, np.minimum(near, far))
