"""The arm in its own images: depth by rays against a plate of known place, and its removal from frames."""

import numpy as np
import pytest

from manipulation.robot import ArmDescription, FingerMotion
from manipulation.self_view import BEHIND, STEP, SelfView, fixed_bounds
from perception.types import CameraIntrinsics, RgbdFrame

# A camera 0.5 m above a plate of 0.2 m x 0.1 m, looking down; x right, y down in the image.
MJCF = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="base">
  <body name="link"><joint name="a" axis="0 0 1" range="-3 3"/>
    <geom group="3" type="box" size=".1 .05 .01" pos="0 0 -.51"/><site name="tcp"/>
    <site name="camera" xyaxes="1 0 0 0 -1 0"/>
    <body name="l"><joint name="l" type="slide" range="0 .04"/></body>
    <body name="r"><joint name="r" type="slide" range="0 .04"/></body>
  </body></body></worldbody></mujoco>"""
INTRINSICS = CameraIntrinsics(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)


@pytest.fixture(scope="module")
def view():
    one = np.ones(1)
    arm = ArmDescription(
        MJCF, ("a",), FingerMotion.sliding(("l", "r"), 0.08), "tcp", "camera", 0 * one, one, one, one
    )
    return SelfView(arm)


def test_depth_is_that_of_the_plate_where_its_pixels_are(view):
    depth = view.depth(np.zeros(1), 0.08, INTRINSICS)
    assert depth.shape == (240 // STEP, 320 // STEP)
    v, u = np.nonzero(np.isfinite(depth))
    np.testing.assert_allclose(depth[v, u], 0.5, atol=1e-6)
    half = 300 * np.array([0.1, 0.05]) / 0.5  # of the plate in pixels
    assert np.ptp(u) * STEP == pytest.approx(2 * half[0], abs=2 * STEP)
    assert np.ptp(v) * STEP == pytest.approx(2 * half[1], abs=2 * STEP)


def test_the_camera_turns_with_the_arm(view):
    np.testing.assert_allclose(
        view.depth(np.ones(1), 0.0, INTRINSICS), view.depth(np.zeros(1), 0.0, INTRINSICS)
    )


def frame_of(depth):
    return RgbdFrame(0.0, np.zeros((240, 320, 3), np.uint8), depth.astype(np.float32), INTRINSICS, np.eye(4))


def test_the_arm_is_removed_and_what_lies_behind_or_beside_it_stays(view):
    depth = np.full((240, 320), 0.8)
    depth[100:140, 120:200] = 0.5  # the plate as measured; the rest is a table behind
    cleaned = view.without_arm(frame_of(depth), np.zeros(1), 0.0).depth
    assert (cleaned[100:140, 120:200] == 0).all()
    assert (cleaned[:40] == np.float32(0.8)).all() and (cleaned == np.float32(0.8)).sum() == (
        depth == 0.8
    ).sum()


def test_frames_without_the_arm_are_returned_as_they_are():
    far = MJCF.replace('pos="0 0 -.51"', 'pos="0 0 .51"')
    one = np.ones(1)
    arm = ArmDescription(
        far, ("a",), FingerMotion.sliding(("l", "r"), 0.08), "tcp", "camera", 0 * one, one, one, one
    )
    frame = frame_of(np.ones((240, 320)))
    assert SelfView(arm).without_arm(frame, np.zeros(1), 0.0) is frame


def test_the_bounds_of_the_base_hold_what_does_not_move():
    base = MJCF.replace(
        '<body name="base">', '<body name="base"><geom group="3" type="box" size=".1 .2 .3"/>'
    )
    one = np.ones(1)
    fingers = FingerMotion.sliding(("l", "r"), 0.08)
    fixed, moving = (
        ArmDescription(text, ("a",), fingers, "tcp", "camera", 0 * one, one, one, one)
        for text in (base, MJCF)
    )
    grown = np.array((0.1, 0.2, 0.3)) + BEHIND
    np.testing.assert_allclose(fixed_bounds(fixed), [[-grown, grown]])
    assert fixed_bounds(moving).shape == (0, 2, 3)
