"""Views of an arm of five joints, whose camera looks along a vertical plane through its first axis."""

import numpy as np
import pytest

from manipulation.kinematics import Kinematics
from manipulation.nearest_view import DISTANCES, FULL_POSE, MAX_OFF_AXIS, NEAREST, nearest_view
from manipulation.robot import ArmDescription, FingerMotion

FIVE = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
<body pos="0 0 .1"><joint name="pan" axis="0 0 1" range="-2 2"/><geom group="3" size=".01"/>
<body><joint name="lift" axis="0 1 0" range="-2 2"/><geom group="3" size=".01"/>
<body pos="0 0 .2"><joint name="bend" axis="0 1 0" range="-.2 2.8"/><geom group="3" size=".01"/>
<body pos="0 0 .2"><joint name="flex" axis="0 1 0" range="-2 2"/><geom group="3" size=".01"/>
<body pos="0 0 .05"><joint name="roll" axis="0 0 1" range="-3 3"/><geom group="3" size=".01"/>
<site name="tcp" pos="0 0 .1"/><site name="camera" pos=".05 0 .05"/>
<body><joint name="left" type="slide" range="0 .04"/><geom group="3" size=".01"/></body>
<body><joint name="right" type="slide" range="0 .04"/><geom group="3" size=".01"/></body>
</body></body></body></body></body></worldbody></mujoco>"""
TARGET = np.array([0.22, 0.0, 0.02])


@pytest.fixture(scope="module")
def kinematics():
    ones = np.ones(5)
    home = np.array([0.0, -0.3, 1.7, 1.7, 0.0])
    joints = ("pan", "lift", "bend", "flex", "roll")
    fingers = FingerMotion.sliding(("left", "right"), 0.08)
    return Kinematics(ArmDescription(FIVE, joints, fingers, "tcp", "camera", home, ones, ones, ones))


def camera_at(azimuth, elevation, distance):
    level = distance * np.cos(elevation)
    return TARGET + np.array([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)])


def seen_from(kinematics, camera):
    seeds = kinematics.seeds_toward(np.eye(4), 6)
    return nearest_view(kinematics, TARGET, camera, seeds, margin=0.1)


def test_a_view_in_the_arms_plane_is_reached(kinematics):
    camera = camera_at(np.pi, np.deg2rad(70), 0.27)
    q = seen_from(kinematics, camera)
    T = kinematics.forward(q, "camera")
    np.testing.assert_allclose(T[:3, 3], camera, atol=0.01)
    assert kinematics.within_limits(q, 0.1 - 1e-9)


def test_a_view_from_the_side_is_replaced_by_one_of_the_same_elevation(kinematics):
    assert len(kinematics.lower) < FULL_POSE
    q = seen_from(kinematics, camera_at(np.pi / 2, np.deg2rad(60), 0.27))
    T = kinematics.forward(q, "camera")
    away = T[:3, 3] - TARGET
    distance = np.linalg.norm(away)
    assert np.arccos(-away @ T[:3, 2] / distance) < MAX_OFF_AXIS
    assert DISTANCES[0] < distance / 0.27 < DISTANCES[1]
    assert np.arcsin(away[2] / distance) == pytest.approx(np.deg2rad(60), abs=0.2)


def test_a_view_from_too_near_is_moved_away(kinematics):
    q = seen_from(kinematics, camera_at(np.pi, np.deg2rad(70), 0.1))
    T = kinematics.forward(q, "camera")
    np.testing.assert_allclose(T[:3, 3], camera_at(np.pi, np.deg2rad(70), NEAREST), atol=0.01)


def test_a_target_out_of_reach_has_no_view(kinematics):
    far = np.array([2.0, 0.0, 0.0])
    assert nearest_view(kinematics, far, far + np.array([0, 0, 0.2]), [kinematics.arm.q_home], 0.1) is None
