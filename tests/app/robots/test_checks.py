"""Checks of arms without simulation: each on a sound arm and on one with its fault."""

from dataclasses import replace

import numpy as np
import pytest

from app.robots import checks
from app.robots.checks import (
    check_camera,
    check_hand,
    check_home,
    check_joints,
    check_objects,
    check_reach,
    loading_faults,
    reachable_radii,
)
from app.task.arm_cell import ArmCell
from manipulation.kinematics import Kinematics
from manipulation.robot import GripperGeometry
from manipulation.workspace import ReachFit, Workspace
from perception.types import CATEGORIES
from sim_assets.robots import load_robot


@pytest.fixture(scope="module")
def arm():
    return load_robot("panda").description


@pytest.mark.parametrize(
    ("hand", "verdict"),
    [
        (GripperGeometry(), "good"),
        (GripperGeometry(max_width=0.05), "warning"),
    ],
)
def test_hands_too_small_are_told(arm, hand, verdict):
    finding = check_hand(replace(arm, gripper=hand))
    assert finding.verdict == verdict and bool(finding.remedy) == (verdict == "warning")


@pytest.mark.parametrize(
    ("hand", "categories", "reason"),
    [
        (GripperGeometry(), CATEGORIES, ""),
        (
            GripperGeometry(min_width=0.014),
            ("bottle", "can"),
            "closes to 14 mm, too wide for the walls of mug, bowl",
        ),
        (
            GripperGeometry(finger_thickness=0.03),
            ("bottle", "can"),
            "fingers of 30 mm do not fit into mug, bowl",
        ),
    ],
)
def test_the_classes_that_a_hand_cannot_hold_are_told(arm, hand, categories, reason):
    finding = check_objects(replace(arm, gripper=hand), ArmCell(0.5, 0.5, 0.03, categories))
    assert finding.verdict == ("warning" if reason else "good") and reason in finding.found
    assert "at 50 % of their usual size" in finding.found


@pytest.mark.parametrize(("count", "verdict"), [(7, "good"), (6, "good"), (5, "warning")])
def test_arms_of_five_joints_are_told_what_they_cannot_do(arm, count, verdict):
    finding = check_joints(replace(arm, joint_names=arm.joint_names[:count]))
    assert finding.verdict == verdict and f"{count} joints" in finding.found


def test_a_good_home(arm):
    (finding,) = check_home(arm, Kinematics(arm))
    assert finding.verdict == "good" and "(0.31, 0.00, 0.49) m" in finding.found


def test_a_home_through_the_table_names_the_link(arm):
    q = np.array([0, 0.9, 0, -1.6, 0, 2.0, 0.0])
    findings = list(check_home(replace(arm, q_home=q), Kinematics(arm)))
    assert any(
        f.verdict == "fault" and "touches table" in f.found and "the arm" not in f.found for f in findings
    )


def test_a_tilted_home_at_a_limit_is_two_warnings(arm):
    q = np.array([2.88, -0.7, 0, -1.5, 0, 1.0, 0.0])
    findings = list(check_home(replace(arm, q_home=q), Kinematics(arm)))
    assert [f.verdict for f in findings] == ["warning", "warning"]
    assert "tilted by" in findings[0].found and "joint1 is 0.02 rad" in findings[1].found


@pytest.mark.parametrize(
    ("reach", "share", "verdict"),
    [((0.3, 0.7), 1.0, "good"), ((0.3, 0.4), 0.8, "warning"), ((0.3,), 0.2, "fault"), ((), 0.0, "fault")],
)
def test_reach_against_the_cell_that_suits(reach, share, verdict):
    finding = check_reach(np.array(reach), ReachFit(Workspace(0.7), share))
    assert finding.verdict == verdict and ("70 %" in finding.found) == bool(reach)


def test_reach_is_that_of_a_vertical_hand(arm, monkeypatch):
    monkeypatch.setattr(checks, "RADII", np.array([0.05, 0.5, 1.1]))
    np.testing.assert_allclose(reachable_radii(Kinematics(arm)), [0.5])


def test_the_camera_does_not_see_the_hand_unless_it_is_put_before_it(arm):
    assert check_camera(arm, 45.0).verdict == "good"
    finding = check_camera(replace(arm, camera_site="tcp"), 120.0)
    assert finding.verdict in ("good", "warning") and "% of the image" in finding.found


def test_faults_on_loading_are_those_of_home_reach_and_camera(arm):
    fine = ReachFit(Workspace(), 1.0)
    assert loading_faults(arm, 45.0, fine) == []
    low = replace(arm, q_home=np.array([0, 0.9, 0, -1.6, 0, 2.0, 0.0]))
    found = loading_faults(low, 45.0, ReachFit(Workspace(), 0.1))
    assert [finding.subject for finding in found] == ["home", "reach"]
