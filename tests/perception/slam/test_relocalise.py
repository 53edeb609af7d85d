"""Relocalisation in a map of cylinders, and its parts in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from perception.io.recordings.sequence import without_pose
from perception.slam.config import SlamConfig
from perception.slam.relocalise import (
    RelocalisationConfig,
    T_level_from_plane,
    _align_planar,
    _class_scores,
    _footprint_centre,
    _match_places,
    relocalise,
)
from perception.types import ObjectDetection, SupportPlane

CONFIG = SlamConfig()


@pytest.fixture(scope="module")
def T_elsewhere(scenes):
    """A view from the other side of the table."""
    return scenes.orbit((0, 0.03, 0.03), 0.6, 50, 200)


@pytest.fixture(scope="module")
def view(observe, T_elsewhere):
    posed = observe(T_elsewhere)
    return replace(posed, frame=without_pose(posed.frame), landmark_of={})


def found_in(world, view, config=CONFIG.relocalisation):
    return relocalise(world, view, CONFIG.tracking, CONFIG.pixels, config)


def test_finds_the_pose_without_a_prediction(cylinders, observe, view, T_elsewhere):
    found = found_in(cylinders.map(), view)
    assert found is not None
    assert np.linalg.norm(found.tracked.T_world_camera[:3, 3] - T_elsewhere[:3, 3]) < 0.005
    assert found.view.landmark_of == observe(T_elsewhere).landmark_of
    np.testing.assert_array_equal(found.view.T_world_camera, found.tracked.T_world_camera)


def test_too_few_landmarks_or_masks_determine_no_pose(cylinders, view):
    world = cylinders.map()
    assert found_in(world.without({0, 1, 2}), view) is None
    assert found_in(world, replace(view, detections=view.detections[:2])) is None
    assert found_in(world, view, RelocalisationConfig(min_matches=6)) is None


def test_a_frame_without_plane_determines_no_pose(cylinders, view):
    dark = replace(view.frame, depth=np.zeros_like(view.frame.depth))
    assert found_in(cylinders.map(), replace(view, frame=dark)) is None


def test_a_map_of_other_classes_does_not_match(cylinders, view):
    world = cylinders.map()
    mugs = [replace(landmark, category="mug") for landmark in world.landmarks.values()]
    certain = [replace(found, score=1.0) for found in view.detections]
    assert found_in(world.with_landmarks(*mugs), replace(view, detections=certain)) is None


def test_a_disagreeing_map_is_rejected(cylinders, view):
    config = RelocalisationConfig(min_inlier_ratio=1.0)
    assert found_in(cylinders.map(), view, config) is None


def test_the_level_frame_has_the_plane_at_zero():
    normal = np.array([0.2, -0.5, 0.7])
    plane = SupportPlane(normal / np.linalg.norm(normal), 0.3)
    T = T_level_from_plane(plane)
    on_plane = plane.normal * plane.offset + np.cross(plane.normal, [0.3, 0.1, -0.4])
    assert (T @ [*on_plane, 1])[2] == pytest.approx(0)
    assert (T @ [*(on_plane + 0.1 * plane.normal), 1])[2] == pytest.approx(0.1)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


def test_planar_alignment_recovers_a_motion():
    rng = np.random.default_rng(0)
    points, angle, move = rng.normal(size=(4, 2)), 2.0, np.array([0.3, -0.1])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rotation, translation = _align_planar(points, points @ turn.T + move)
    np.testing.assert_allclose(rotation, turn, atol=1e-12)
    np.testing.assert_allclose(translation, move, atol=1e-12)


def test_places_match_by_distance_and_class():
    points, places = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[1.0, 0.01], [0.0, 0.02], [5.0, 5.0]])
    score, matches = _match_places(points, places, np.zeros((2, 3)), 0.05)
    assert matches == {0: 1, 1: 0} and score == pytest.approx(2 - 0.3 * (0.02 + 0.01) / 0.05)
    unlikely = np.array([[0.0, -4.0, 0.0], [-1.0, 0.0, 0.0]])
    score, matches = _match_places(points, places, unlikely, 0.05)
    assert matches == {1: 0} and score == pytest.approx(1 - 0.3 * 0.01 / 0.05 - 0.1)
    assert _match_places(points, places + 0.074, np.zeros((2, 3)), 0.05)[1] == {}


def test_class_scores_are_relative_to_the_best_class(cylinders):
    mask = np.ones((2, 2), bool)
    found = [ObjectDetection("mug", 0.7, mask), ObjectDetection("can", 0.7, mask)]
    world = cylinders.map()  # of cans
    scores = _class_scores(world, found)
    np.testing.assert_allclose(scores[0], np.log(0.1 / 0.7))
    np.testing.assert_allclose(scores[1], 0, atol=1e-12)


def test_the_footprint_centre_of_a_cylinder_is_its_axis(scenes, cylinders):
    T = scenes.orbit((0, 0, 0.03), 0.5, 35, 70)
    scene = scenes.render([scenes.Solid(0.05, -0.02, 0.1, radius=0.04)], T)
    found = ObjectDetection("can", 0.9, scene.instances == 0)
    centre = _footprint_centre(scene.frame, found, T)
    np.testing.assert_allclose(centre, [0.05, -0.02], atol=0.006)
    table = ObjectDetection("can", 0.9, scene.instances == -1)
    assert _footprint_centre(scene.frame, table, T) is None
