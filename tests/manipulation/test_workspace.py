"""Scaled cells are similar to the standard one, and as large as the arm's reach allows."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation import workspace
from manipulation.kinematics import Kinematics
from manipulation.planner import ManipulationConfig
from manipulation.viewpoints import BOX_VIEWPOINTS, KEEP_OUT, LINE_VIEWPOINTS, SCAN_VIEWPOINTS
from manipulation.workspace import (
    ENOUGH,
    SCALES,
    ReachFit,
    Workspace,
    arm_workspace,
    fit_workspace,
    place_poses,
    reachable_share,
)
from sim_assets.robots import load_robot


@pytest.fixture(scope="module")
def kinematics():
    return Kinematics(load_robot("panda").description)


def test_scale_one_is_the_standard_cell():
    space, config = Workspace(), ManipulationConfig()
    assert (space.scan_viewpoints(), space.box_viewpoints) == (SCAN_VIEWPOINTS, BOX_VIEWPOINTS)
    assert space.line_viewpoints == LINE_VIEWPOINTS and space.keep_out == KEEP_OUT
    assert space.adapted(config) == config


def test_a_scaled_camera_pose_is_similar():
    for small, full in zip(Workspace(0.6).scan_viewpoints(), SCAN_VIEWPOINTS, strict=True):
        T, T_full = small.camera_pose(0.3), full.camera_pose(0.3)
        np.testing.assert_allclose(T[:3, :3], T_full[:3, :3])
        np.testing.assert_allclose(T[:3, 3], 0.6 * T_full[:3, 3])


def test_closeups_look_at_the_object_itself():
    for viewpoint in Workspace(0.5).closeup_viewpoints(0.3, -0.1):
        assert viewpoint.target == (0.3, -0.1, 0.025) and viewpoint.distance < 0.26


def test_heights_of_motions_scale_and_margins_do_not():
    config = ManipulationConfig()
    adapted = Workspace(0.5).adapted(config)
    np.testing.assert_allclose(adapted.free_area, 0.5 * np.array(config.free_area))
    small = adapted.pick_place
    np.testing.assert_allclose(small.via_heights, 0.5 * np.array(config.pick_place.via_heights))
    assert small.segments.lift.heights[0] == 0.5 * config.pick_place.segments.lift.heights[0]
    assert small.segments.lift.margin == config.pick_place.segments.lift.margin


def test_places_are_vertical_poses_over_the_scaled_cell(kinematics):
    full, raised = place_poses(kinematics, 1.0), place_poses(kinematics, 0.5, lift=0.1)
    for T, T_raised in zip(full, raised, strict=True):
        np.testing.assert_allclose(T[:3, 2], [0, 0, -1])
        np.testing.assert_allclose(T_raised[:3, 3], 0.5 * T[:3, 3] - [0, 0, 0.1])


def test_the_shipped_arms_reach_the_whole_standard_cell(kinematics):
    assert fit_workspace(kinematics).workspace == Workspace(1.0)
    assert fit_workspace(Kinematics(load_robot("sixaxis").description)).workspace == Workspace(1.0)


def test_an_arm_on_a_pedestal_that_is_too_high_gets_a_smaller_cell(kinematics):
    fit = fit_workspace(kinematics, lift=0.4)
    assert reachable_share(kinematics, 1.0, lift=0.4) < ENOUGH and fit.workspace.scale < 1.0
    assert fit.share == reachable_share(kinematics, fit.workspace.scale, lift=0.4)


def test_an_arm_that_reaches_nothing_has_no_share(kinematics):
    fit = fit_workspace(kinematics, lift=3.0)
    assert fit.share == 0.0 and fit.workspace.scale in SCALES


def test_the_workspace_of_an_arm_is_computed_once(monkeypatch):
    arm, scales = load_robot("panda").description, iter((0.9, 0.8))
    monkeypatch.setattr(workspace, "_FITS", {})
    monkeypatch.setattr(workspace, "fit_workspace", lambda _: ReachFit(Workspace(next(scales)), 1.0))
    assert arm_workspace(arm) is arm_workspace(arm)
    assert arm_workspace(replace(arm, q_home=arm.q_home + 0.1)).workspace.scale == 0.8
