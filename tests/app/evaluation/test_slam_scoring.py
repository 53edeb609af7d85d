"""Trajectory errors, matching by position, surface rows and completion curves."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from app.evaluation import slam_scoring
from app.evaluation.slam_scoring import (
    MATCH_DISTANCE,
    TrueObjects,
    absolute_pose_error,
    centre_of,
    completion_by_update,
    match_places,
    surface_rows,
)
from perception.inference.meshing import EmptyShapeError
from perception.inference.problem import FitState
from perception.inference.shape_model import LinearisedShape
from perception.io.recordings.trajectory import Trajectory
from perception.rendering.pose import ObjectPose
from perception.slam.landmarks import Landmark
from perception.types import TriangleMesh


def test_the_error_of_a_shifted_trajectory_is_the_shift():
    pytest.importorskip("evo")
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    moved = poses.copy()
    moved[:, 1, 3] += 0.02
    times = np.arange(5) / 30
    error = absolute_pose_error(Trajectory(times[1:], moved[1:]), Trajectory(times, poses))
    assert error == pytest.approx({"ape_mean": 0.02, "ape_rmse": 0.02, "ape_max": 0.02})


def test_true_objects_are_matched_by_position():
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    meshes = [("mug", TriangleMesh(corners + shift, faces)) for shift in (0.0, 0.5)]
    truth = TrueObjects(meshes, np.random.default_rng(0))

    places = {7: np.full(3, 0.56), 8: np.full(3, 0.06), 9: np.full(3, 2.0)}
    assert truth.match(places) == {7: 1, 8: 0}
    assert truth.match({}) == {}


def test_matching_is_one_to_one_within_the_match_distance():
    centres = np.array([[0.0, 0, 0], [0.05, 0, 0]])
    near, far = np.array([0.99 * MATCH_DISTANCE, 1.01 * MATCH_DISTANCE])
    assert match_places({3: np.array([-near, 0, 0])}, centres) == {3: 0}
    assert match_places({3: np.array([-far, 0, 0])}, centres) == {}
    # the optimal assignment, not the greedy one
    assert match_places({1: np.array([0.04, 0, 0]), 2: np.array([0.06, 0, 0])}, centres) == {1: 0, 2: 1}


def test_the_centre_is_that_of_the_bounding_box():
    np.testing.assert_allclose(centre_of(np.array([[0.0, 0, 0], [2, 4, 6], [0, 0, 1]])), [1, 2, 3])


def test_errors_are_not_aligned_and_have_root_mean_square_and_maximum():
    pytest.importorskip("evo")
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = np.arange(4)
    moved = poses.copy()
    moved[:2, 2, 3] += 0.04
    times = np.arange(4) / 30
    error = absolute_pose_error(Trajectory(times, moved), Trajectory(times, poses))
    expected = {"ape_mean": 0.02, "ape_rmse": 0.04 / np.sqrt(2), "ape_max": 0.04}
    assert error == pytest.approx(expected)


@pytest.fixture
def spheres(monkeypatch):
    """A true ball at the origin, and landmarks whose meshes are balls of given radii (0: no surface)."""

    def ball(radius):
        mesh = trimesh.creation.icosphere(3, radius)
        return TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))

    def estimate(landmark, decoder):
        if landmark.bounding_radius == 0:
            raise EmptyShapeError("empty")
        return SimpleNamespace(mesh_world=ball(landmark.bounding_radius))

    grid = np.zeros((32, 32, 32), np.float32)
    shape = LinearisedShape(grid, np.zeros((*grid.shape, 16), np.float32), np.zeros(16))

    def landmark(id, radius, x=0.0):
        state = FitState(ObjectPose(np.eye(3), np.array([x, 0.0, 0.0]), np.ones(3)), np.zeros(16))
        return Landmark(id, "can", state, shape, radius, 0.5, np.zeros(4), n_updates=2, n_hits=5)

    monkeypatch.setattr(slam_scoring, "object_estimate", estimate)
    return TrueObjects([("mug", ball(0.05))], np.random.default_rng(0)), landmark


class NoDecoder:
    """Stands in where meshes are given."""

    def __call__(self, category, codes):
        raise NotImplementedError

    def with_jacobian(self, category, code, threads=1):
        raise NotImplementedError


def rows_of(landmarks, truth):
    return surface_rows(landmarks, truth, NoDecoder(), np.random.default_rng(0))


def test_surface_rows_score_matched_landmarks_alone(spheres):
    truth, landmark = spheres
    good, elsewhere = rows_of([landmark(4, 0.052), landmark(9, 0.05, x=1.0)], truth)
    assert (good["id"], good["true_category"], good["true_index"]) == (4, "mug", 0)
    assert (good["updates"], good["hits"]) == (2, 5)
    assert good["accuracy"] == pytest.approx(0.002, abs=3e-4) and good["completion"] == 1.0
    assert elsewhere["true_category"] is None and "accuracy" not in elsewhere
    (empty,) = rows_of([landmark(4, 0.0)], truth)
    assert empty["true_category"] == "mug" and "accuracy" not in empty


def test_completion_follows_the_updates_of_matched_landmarks(spheres):
    truth, landmark = spheres
    history = {4: [landmark(4, 0.0), landmark(4, 0.02), landmark(4, 0.05)], 9: [landmark(9, 0.05, x=1.0)]}
    curves = completion_by_update(history, truth, NoDecoder(), np.random.default_rng(0))
    assert curves == [[0.0, 0.0, 1.0]]
