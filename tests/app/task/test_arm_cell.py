"""Cells that suit an arm: scales by reach and opening, and what is impossible."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from app.options import PackOptions
from app.task.arm_cell import (
    BELOW_RIM,
    FULL_OPENING,
    GRAVITY,
    SMALLEST,
    ArmCell,
    arm_cell,
    box_of,
    cell_remarks,
    narrowest_grip,
    payload,
    scales_of,
)
from manipulation.robot import GripperGeometry
from manipulation.workspace import ReachFit, Workspace
from perception.types import CATEGORIES
from sim_assets.cell.scene import BoxConfig
from sim_assets.objects import sample_object
from sim_assets.robots import load_robot


def with_opening(width):
    robot = load_robot("panda")
    hand = replace(robot.description.gripper, max_width=width)
    return replace(robot, description=replace(robot.description, gripper=hand))


@pytest.mark.parametrize(
    ("scale", "width", "expected"),
    [
        (1.0, 0.08, ArmCell()),
        (0.75, 0.08, ArmCell(0.75, 0.75)),
        (0.75, 0.8 * FULL_OPENING, ArmCell(0.75, 0.75)),
        (1.0, 0.8 * FULL_OPENING, ArmCell(1.0, 0.8)),
        (1.0, 0.01, ArmCell(1.0, SMALLEST)),
    ],
)
def test_objects_suit_reach_and_opening(scale, width, expected):
    found = scales_of(ReachFit(Workspace(scale), 1.0), with_opening(width))
    assert found == replace(expected, lowest=BELOW_RIM + GripperGeometry().tip)


@pytest.mark.parametrize(("closes_to", "classes"), [(0.002, CATEGORIES), (0.008, ("bottle", "can"))])
def test_objects_are_drawn_that_the_hand_can_hold(closes_to, classes):
    robot = with_opening(0.08)
    hand = replace(robot.description.gripper, min_width=closes_to)
    robot = replace(robot, description=replace(robot.description, gripper=hand))
    assert scales_of(ReachFit(Workspace(1.0), 1.0), robot).categories == classes


@pytest.mark.parametrize(
    ("scale", "thickness", "classes"),
    [
        (0.8, 0.032, CATEGORIES),
        (0.5, 0.035, ("bowl", "bottle", "can")),  # 37 mm inside a mug, 55 mm inside a bowl
        (0.35, 0.025, ("bottle", "can")),
    ],
)
def test_fingers_fit_into_the_vessels_that_are_drawn(scale, thickness, classes):
    robot = with_opening(0.08)
    hand = replace(robot.description.gripper, finger_thickness=thickness)
    robot = replace(robot, description=replace(robot.description, gripper=hand))
    assert set(scales_of(ReachFit(Workspace(scale), 1.0), robot).categories) == set(classes)


def test_shipped_arms_have_the_standard_cell():
    assert arm_cell(PackOptions(robot="sixaxis"), with_opening(0.01)) == ArmCell()


def test_a_box_of_given_size_is_only_moved():
    inner = (0.34, 0.30, 0.08)
    assert box_of(PackOptions(), inner, 1.0) == BoxConfig()
    scaled = box_of(PackOptions(), inner, 0.5)
    assert scaled.inner == (0.17, 0.15, 0.04) and scaled.center == (0.25, 0.135)
    given = box_of(PackOptions(box="0.2,0.2,0.05"), (0.2, 0.2, 0.05), 0.5)
    assert given.inner == (0.2, 0.2, 0.05) and given.center == (0.25, 0.135)


def world(objects, arm=None, torques=np.full(7, np.inf), force=70.0, scale=1.0):
    return SimpleNamespace(
        arm=arm or load_robot("panda").description,
        config=SimpleNamespace(objects=objects, scale=scale),
        torque_limits=lambda: torques,
        grip_force=lambda: force,
    )


def test_payload_by_friction_alone():
    """Two pads of 70 N at friction 0.6, half of it in reserve: 42 N."""
    assert payload(world(())) == pytest.approx(42.0 / GRAVITY)


def test_payload_by_torque_is_that_of_the_longest_lever():
    """At 0.75 m from the shoulder's axis, 30 Nm hold 40 N; the second joint carries it all."""
    torques = np.full(7, np.inf)
    torques[1] = 30.0
    assert 0.5 * 30.0 / 0.85 / GRAVITY < payload(world((), torques=torques)) < 0.5 * 30.0 / 0.6 / GRAVITY


def test_what_is_too_wide_or_heavy_is_said():
    can = sample_object("can", "test", np.random.default_rng(0))
    mug = sample_object("mug", "test", np.random.default_rng(0))
    narrow = with_opening(narrowest_grip(can)).description
    assert list(cell_remarks(world((can, mug)))) == []
    (line,) = cell_remarks(world((can, mug), arm=narrow))
    assert line.startswith("object 0 (can) is") and "it will be left" in line
    (line,) = cell_remarks(world((replace(can, mass=30.0),)))
    assert "weighs 30000 g, the arm lifts" in line
    (line,) = cell_remarks(world((), scale=0.75))
    assert line == "the cell has 75 % of its standard size, by the arm's reach"
