"""Ground plane and initial view of recordings with and without a cell."""

import numpy as np
import pytest

from app.runs.replay import Recorder
from app.viewer.surroundings import surroundings_of
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame, TriangleMesh

TETRAHEDRON = TriangleMesh(
    np.array([(-0.05, -0.05, -0.04), (0.05, -0.05, -0.04), (0, 0.05, -0.04), (0, 0, 0.06)]),
    np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]),
)


def leaning(T_world_support, x):
    """Return an object that stands at (x, 0) m on a support."""
    T = T_world_support.copy()
    T[:3, 3] += T[:3, :3] @ (x, 0.0, 0.04)
    return ObjectEstimate(0, "can", np.zeros(16), T, np.full(3, 0.1), TETRAHEDRON)


def image(T_world_camera):
    camera = CameraIntrinsics(8, 6, 7.0, 7.0, 3.5, 2.5)
    return RgbdFrame(0.0, np.zeros((6, 8, 3), np.uint8), np.zeros((6, 8), np.float32), camera, T_world_camera)


def test_a_cell_has_its_floor_and_a_fixed_view(recording):
    surroundings = surroundings_of(recording)
    assert surroundings.has_floor and surroundings.up.tolist() == [0, 0, 1]
    assert not surroundings_of(Recorder()).has_floor


def test_the_support_plane_of_the_objects_defines_the_up_direction():
    T = np.eye(4)
    T[:3, :3] = np.array([(1, 0, 0), (0, -0.6, -0.8), (0, 0.8, -0.6)]).T  # a camera's y points down
    T[:3, 3] = 0.1, 0.2, 0.7
    recorder = Recorder(objects=(leaning(T, -0.1), leaning(T, 0.1)), frames=[image(np.eye(4))])
    surroundings = surroundings_of(recorder)
    np.testing.assert_allclose(surroundings.up, T[:3, 2], atol=1e-9)
    np.testing.assert_allclose(surroundings.T_world_ground[:3, 3], T[:3, 3], atol=1e-9)
    away = surroundings.position - T[:3, 3]
    assert away @ surroundings.up > 0.3 * np.linalg.norm(away)  # from above the support
    assert np.linalg.norm(away) > np.linalg.norm(T[:3, 3])


def test_images_without_objects_are_viewed_at_the_centre_of_their_views():
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = 0.3, 0.0, 0.5
    surroundings = surroundings_of(Recorder(frames=[image(T), image(T)]))
    np.testing.assert_allclose(surroundings.T_world_ground[:3, 3], (0.3, 0.0, 0.0), atol=1e-9)
    assert surroundings.up == pytest.approx([0, 0, 1])
