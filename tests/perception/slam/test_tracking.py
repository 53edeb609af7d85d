"""Tracking from disturbed starts, occlusion, outcasts, and what the pixels are."""

from dataclasses import replace

import numpy as np
import pytest

from perception.geometry import se3_exp
from perception.inference.problem import FitState
from perception.rendering.pose import ObjectPose, object_by_camera
from perception.slam.landmarks import own_doubt
from perception.slam.pixels import SelectionConfig, label_image, select_pixels
from perception.slam.tracking import TrackingConfig, track
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame


def observe(cylinders, T, T_start):
    frame, detections, shown = cylinders.look(T)
    labels = label_image(detections, frame.depth.shape)
    landmark_of = {k + 1: one for k, one in enumerate(shown)}
    return select_pixels(frame, labels, landmark_of, T_start, cylinders.plane, SelectionConfig())


@pytest.fixture
def T_true(scenes):
    return scenes.orbit((0, 0.03, 0.03), 0.55, 45, 20)


@pytest.mark.parametrize("seed", range(4))
def test_finds_the_pose_from_a_disturbed_start(cylinders, T_true, seed):
    rng = np.random.default_rng(seed)
    off = np.concatenate([rng.normal(0, np.radians(0.8), 3), rng.normal(0, 0.008, 3)])
    T_start = T_true @ se3_exp(off)
    config = TrackingConfig(iterations=8, use_plane=False).loosened(5.0)
    found = track(cylinders.map(), observe(cylinders, T_true, T_start), T_start, config)
    assert np.linalg.norm(found.T_world_camera[:3, 3] - T_true[:3, 3]) < 0.003
    assert found.share > 0.9 and len(found.used) == 5


def test_the_plane_holds_what_it_can(cylinders, T_true):
    T_start = T_true @ se3_exp(np.array([0.01, 0.01, 0, 0, 0.005, 0.01]))
    pixels = observe(cylinders, T_true, T_start)
    found = track(cylinders.map(), pixels, T_start, TrackingConfig(iterations=6).loosened(5.0))
    normal, true_normal = found.T_world_camera[2, :3], T_true[2, :3]
    assert np.degrees(np.arccos(np.clip(normal @ true_normal, -1, 1))) < 0.05
    assert abs(found.T_world_camera[2, 3] - T_true[2, 3]) < 5e-4


def test_an_object_that_was_moved_is_left_out(cylinders, T_true):
    world = cylinders.map()
    one = world.landmarks[0]
    pose = ObjectPose(
        one.state.pose.rotation, one.state.pose.translation + np.array((0.04, 0.02, 0)), one.state.pose.scale
    )
    world = world.with_landmarks(one.with_state(FitState(pose, one.state.code)))
    found = track(world, observe(cylinders, T_true, T_true), T_true, TrackingConfig(iterations=6))
    assert 0 not in found.used and found.shares[0] < 0.5 and found.share_of_used > 0.8
    assert np.linalg.norm(found.T_world_camera[:3, 3] - T_true[:3, 3]) < 0.003


def test_nothing_seen_is_no_pose_to_believe(cylinders, T_true):
    pixels = observe(cylinders, T_true, T_true)
    empty = type(pixels)(*(values[:0] for values in vars(pixels).values()))
    found = track(cylinders.map(), empty, T_true, TrackingConfig())
    assert found.share == 0 and not found.used
    np.testing.assert_allclose(found.T_world_camera, T_true, atol=1e-9)


def test_information_says_how_well_the_pose_is_held(cylinders, T_true):
    both = track(cylinders.map(), observe(cylinders, T_true, T_true), T_true, TrackingConfig())
    alone = track(
        cylinders.map(), observe(cylinders, T_true, T_true), T_true, TrackingConfig(use_plane=False)
    )
    assert np.linalg.eigvalsh(alone.information)[0] < np.linalg.eigvalsh(both.information)[0]


def test_a_landmark_tells_no_more_of_the_pose_than_of_itself(cylinders, T_true):
    pixels = observe(cylinders, T_true, T_true)
    config, sure, vague = TrackingConfig(use_plane=False), 1e-9 * np.eye(6), own_doubt(cut=True)

    def information(doubt):
        world = cylinders.map()
        world = world.with_landmarks(*(replace(one, doubt=doubt) for one in world.landmarks.values()))
        return track(world, pixels, T_true, config).information

    plain, shared = information(sure), information(vague)
    assert np.linalg.eigvalsh(plain - shared)[0] > -1e-6 * np.trace(plain)
    known = np.zeros((6, 6))
    for one in cylinders.map().landmarks.values():
        by_camera = object_by_camera(one.state.pose, T_true)
        known += by_camera.T @ np.linalg.inv(vague) @ by_camera
    assert np.linalg.eigvalsh(known - shared)[0] > -1e-6 * np.trace(known)


def test_a_landmark_is_known_as_the_camera_that_saw_it(cylinders, T_true):
    landmark = cylinders.landmark(1)
    shift = np.diag([0, 0, 0, 4e-6, 4e-6, 4e-6])
    assert landmark.seen_from(T_true, shift) - own_doubt(False) == pytest.approx(shift)
    turn = np.diag([1e-4, 1e-4, 1e-4, 0, 0, 0])
    doubt = landmark.seen_from(T_true, turn) - own_doubt(False)
    away = np.linalg.norm(landmark.state.pose.translation - T_true[:3, 3])
    assert np.trace(doubt[3:, 3:]) == pytest.approx(2e-4 * away**2)  # two of three axes move it, by the lever
    assert np.trace(own_doubt(True)) > np.trace(own_doubt(False))


def test_pixels_keep_off_borders_and_rings_off_other_objects(cylinders, T_true):
    frame, detections, shown = cylinders.look(T_true, noise=0.0)
    labels = label_image(detections, frame.depth.shape)
    config = SelectionConfig()
    pixels = select_pixels(frame, labels, {1: shown[0]}, T_true, cylinders.plane, config)
    assert set(pixels.owner) == {shown[0]}
    assert pixels.is_object.sum() <= config.on_object and (~pixels.is_object).sum() <= config.in_ring
    k = frame.intrinsics
    u = np.rint(pixels.directions[:, 0] * k.fx + k.cx).astype(int)
    v = np.rint(pixels.directions[:, 1] * k.fy + k.cy).astype(int)
    for row, column, inside in zip(v, u, pixels.is_object):
        patch = labels[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        assert (patch == (1 if inside else 0)).all()
    heights = pixels.plane_points @ T_true[2, :3] + T_true[2, 3]
    assert np.abs(heights).max() < 1e-3


def test_smaller_masks_win_where_labels_overlap():
    big, small = np.zeros((8, 8), bool), np.zeros((8, 8), bool)
    big[1:7, 1:7], small[3:5, 3:5] = True, True
    labels = label_image([ObjectDetection("mug", 1.0, small), ObjectDetection("mug", 1.0, big)], (8, 8))
    assert labels[4, 4] == 1 and labels[1, 1] == 2 and labels[0, 0] == 0


def test_larger_images_give_the_same_pixels_from_every_second_one(cylinders, T_true):
    frame, detections, _ = cylinders.look(T_true, noise=0.0)
    k, labels = frame.intrinsics, label_image(detections, frame.depth.shape)
    double = CameraIntrinsics(2 * k.width, 2 * k.height, 2 * k.fx, 2 * k.fy, 2 * k.cx, 2 * k.cy)
    large = RgbdFrame(
        0.0,
        *(np.repeat(np.repeat(image, 2, axis=0), 2, axis=1) for image in (frame.rgb, frame.depth)),
        double,
    )
    large_labels = np.repeat(np.repeat(labels, 2, axis=0), 2, axis=1)
    small, big = (
        select_pixels(image, shown, {1: 0, 2: 1}, T_true, cylinders.plane, SelectionConfig())
        for image, shown in ((frame, labels), (large, large_labels))
    )
    np.testing.assert_allclose(big.directions, small.directions, atol=1e-12)
    np.testing.assert_array_equal(big.depth, small.depth)
    np.testing.assert_allclose(big.plane_points, small.plane_points, atol=1e-9)


def test_objects_that_began_cut_count_less_while_enough_others_hold(cylinders, T_true):
    world, pixels = cylinders.map(), observe(cylinders, T_true, T_true)

    def information(cut):
        changed = world.with_landmarks(*(replace(world.landmarks[one], cut=True) for one in cut))
        found = track(changed, pixels, T_true, TrackingConfig(use_plane=False))
        assert len(found.used) == 5
        return np.trace(found.information)

    whole = information([])
    assert information([0]) < 0.95 * whole
    assert information([0, 1, 2]) == pytest.approx(whole, rel=1e-6)  # two others are not enough
