"""Pose checks of objects in place, moved, absent, occluded and filled."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.geometry import rigid, so3_exp
from perception.inference.refit import (
    STANDING,
    refit_leaning,
    refit_pose,
)
from perception.types import ObjectEstimate, RgbdFrame, TriangleMesh

AZIMUTHS = (0.3, 1.5, 2.7)


def _frames(table, present: bool = True) -> list[RgbdFrame]:
    rng = np.random.default_rng(5)
    return [table.frame(table.camera(azimuth), rng, present)[0] for azimuth in AZIMUTHS]


def test_object_in_place_is_seen_there(mug, estimate) -> None:
    check = refit_pose(estimate, _frames(mug), mug.pose.T_world_object)
    assert check.status == "seen"
    assert check.inlier_share > 0.9
    assert check.visible_pixels > 2000
    assert check.shift < 0.002
    assert check.tilt < np.deg2rad(1.5)


def test_moved_object_is_found(mug, estimate) -> None:
    T_expected = rigid(so3_exp(np.array([0, 0, 0.2])), np.array([0.012, -0.01, 0.0])) @ np.eye(4)
    T_expected[:3, :3] = T_expected[:3, :3] @ mug.pose.rotation
    T_expected[:3, 3] += mug.pose.translation
    check = refit_pose(estimate, _frames(mug), T_expected)
    assert check.status == "seen"
    np.testing.assert_allclose(check.T_world_object[:3, 3], mug.pose.translation, atol=0.002)
    np.testing.assert_allclose(check.T_world_object[:3, :3], mug.pose.rotation, atol=0.06)
    assert check.shift == pytest.approx(np.hypot(0.012, 0.01), abs=0.002)


def test_tilt_is_measured(mug, estimate, make_table) -> None:
    leaning = type(mug)(
        mug.decoder, mug.category, mug.code, mug.pose.moved(np.array([0.15, 0, 0] + [0.0] * 6))
    )
    check = refit_pose(estimate, _frames(leaning), mug.pose.T_world_object)
    assert check.status == "seen"
    assert check.tilt == pytest.approx(0.15, abs=0.03)


@pytest.mark.parametrize("lean", [(0.4, 0.0), (-0.2, 0.3), (0.0, 0.0)])
def test_an_object_that_may_lean_is_found_with_its_tilt_or_level(mug, estimate, lean) -> None:
    """However large the tilt is; a level one is not given the small tilt of an inexact fit."""
    leaning = type(mug)(mug.decoder, mug.category, mug.code, mug.pose.moved(np.array([*lean] + [0.0] * 7)))
    check = refit_leaning(estimate, _frames(leaning), mug.pose.T_world_object)
    assert check.status == "seen" and check.inlier_share > 0.9
    assert check.tilt == pytest.approx(np.hypot(*lean), abs=0.05)
    if not any(lean):
        assert check.tilt < np.deg2rad(0.5)


def test_an_object_that_was_pushed_aside_is_found_level(mug, estimate) -> None:
    """Farther than a fit from its expected pose reaches."""
    aside = np.array([0.055, -0.02, 0.0])
    step = np.array([0.0, 0.0, 0.0, *aside, 0.0, 0.0, 0.0])
    pushed = type(mug)(mug.decoder, mug.category, mug.code, mug.pose.moved(step))
    check = refit_leaning(estimate, _frames(pushed), mug.pose.T_world_object)
    assert check.status == "seen" and check.inlier_share > 0.9 and check.tilt < np.deg2rad(1.0)
    np.testing.assert_allclose(check.T_world_object[:3, 3], pushed.pose.translation, atol=0.002)
    assert check.shift == pytest.approx(np.linalg.norm(aside), abs=0.002)


def test_an_object_that_stands_is_found_level(mug, estimate) -> None:
    leaning = type(mug)(mug.decoder, mug.category, mug.code, mug.pose.moved(np.array([0.15] + [0.0] * 8)))
    check = refit_pose(estimate, _frames(leaning), mug.pose.T_world_object, config=STANDING)
    assert check.tilt < np.deg2rad(0.1)
    assert refit_pose(estimate, _frames(leaning), mug.pose.T_world_object).tilt > np.deg2rad(6)


def test_absent_object_is_not_there(mug, estimate) -> None:
    check = refit_pose(estimate, _frames(mug, present=False), mug.pose.T_world_object)
    assert check.status == "not_there"
    np.testing.assert_array_equal(check.T_world_object, mug.pose.T_world_object)


def test_covered_object_is_hidden(mug, estimate) -> None:
    covered = []
    for frame in _frames(mug):
        depth = np.full_like(frame.depth, 0.25)
        covered.append(RgbdFrame(0.0, frame.rgb, depth, frame.intrinsics, frame.T_world_camera))
    check = refit_pose(estimate, covered, mug.pose.T_world_object)
    assert check.status == "hidden"
    assert check.visible_pixels < 80


def test_no_view_of_the_place_is_hidden(estimate, mug) -> None:
    check = refit_pose(estimate, [], mug.pose.T_world_object)
    assert (check.status, check.visible_pixels) == ("hidden", 0)


def test_a_neighbour_is_not_taken_for_the_object(mug, estimate) -> None:
    """The place is empty, but the same shape stands 5 cm farther: it explains its own depth."""
    beside = type(mug)(
        mug.decoder, mug.category, mug.code, mug.pose.moved(np.array([0, 0, 0, 0.05, 0, 0, 0, 0, 0]))
    )
    neighbour = ObjectEstimate(1, "mug", mug.code, beside.pose.T_world_object, mug.pose.scale, estimate.mesh)
    check = refit_pose(estimate, _frames(beside), mug.pose.T_world_object, [neighbour])
    assert check.status == "not_there"


def test_an_object_is_not_found_in_the_surface_of_one_below(mug, estimate) -> None:
    """The same shape is a little lower and aside; a fit of the pose leads there."""
    T_expected = mug.pose.T_world_object.copy()
    T_expected[[0, 2], 3] += 0.006
    there = ObjectEstimate(1, "mug", mug.code, mug.pose.T_world_object, mug.pose.scale, estimate.mesh)
    assert refit_pose(estimate, _frames(mug), T_expected).status == "seen"
    for check in (refit_pose, refit_leaning):
        assert check(estimate, _frames(mug), T_expected, [there]).status == "not_there"
    higher = replace(there, T_world_object=there.T_world_object @ rigid(np.eye(3), np.array([0, 0, 0.007])))
    assert refit_pose(estimate, _frames(mug), T_expected, [higher]).status == "seen"


def test_contents_do_not_lift_a_bowl(scenes) -> None:
    """A bowl filled to the brim shows a flat top, 25 mm over the floor of the known shape."""
    radius, height = 0.05, 0.035
    profile = [
        (0, 0),
        (radius, 0),
        (radius, height),
        (radius - 0.006, height),
        (radius - 0.006, 0.01),
        (0, 0.01),
    ]
    bowl = trimesh.creation.revolve(np.array(profile), sections=48)
    middle = np.array([0.0, 0.0, height / 2])
    mesh = TriangleMesh(bowl.vertices - middle, bowl.faces)
    T = rigid(np.eye(3), np.array([0.4, -0.2, height / 2]))
    known = ObjectEstimate(0, "bowl", np.zeros(16), T, np.full(3, radius / 0.9), mesh)
    filled = scenes.Solid(0.4, -0.2, height, radius=radius)
    view = scenes.render([filled], scenes.orbit((0.4, -0.2, 0.0), 0.5, 60, 40), 0.001)
    check = refit_pose(known, [view.frame], T)
    assert check.status == "seen"
    assert check.shift < 0.003 and check.tilt < np.deg2rad(3)
