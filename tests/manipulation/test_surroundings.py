import numpy as np
import pytest
from scipy.spatial import KDTree

from manipulation import surroundings
from manipulation.standing import to_standing
from manipulation.surroundings import REACH, Surfaces, points_around
from perception.geometry import pose_from_yaw
from perception.obstacles.obstacle import PerceivedObstacle

CORNERS = np.array(list(np.ndindex(2, 2, 2)), dtype=float)


def test_points_lie_on_the_surface_in_the_given_pose(shapes):
    can = to_standing(shapes.estimate(1, "can", shapes.can(0.03, 0.1)))
    T = pose_from_yaw(0.4, np.array([0.5, -0.2, 0.03]))
    center = np.array([0.45, -0.2, 0.0])
    points = points_around(center, [(can, T)], []) + center - T[:3, 3]
    radius = np.linalg.norm(points[:, :2], axis=1)
    on_side = points[(points[:, 2] > 1e-3) & (points[:, 2] < 0.099)]
    assert len(on_side) > 50 and radius.max() < 0.0305
    np.testing.assert_allclose(np.linalg.norm(on_side[:, :2], axis=1), 0.03, atol=1e-3)


def test_things_of_no_class_are_covered_densely():
    block = PerceivedObstacle(0, (np.array([0.5, -0.2, 0.0]) + 0.08 * CORNERS,), 100)
    points = points_around(np.array([0.5, -0.2, 0.0]), [], [block])
    assert points.min() == pytest.approx(0.0, abs=1e-9) and points.max() == pytest.approx(0.08, abs=1e-9)
    face = np.stack(
        [*np.meshgrid(np.linspace(0, 0.08, 20), np.linspace(0, 0.08, 20)), np.full((20, 20), 0.08)]
    )
    assert KDTree(points).query(face.reshape(3, -1).T)[0].max() < 0.010


def test_what_is_out_of_the_hands_reach_is_left_out():
    far = PerceivedObstacle(0, (np.array([0.5 + REACH, 0.0, 0.0]) + 0.01 + 0.05 * CORNERS,), 100)
    assert points_around(np.array([0.5, 0.0, 0.0]), [], [far]).shape == (0, 3)


def test_surfaces_are_sampled_once(shapes, monkeypatch):
    can = to_standing(shapes.estimate(1, "can", shapes.can(0.03, 0.1)))
    block = PerceivedObstacle(0, (np.array([0.5, -0.2, 0.0]) + 0.08 * CORNERS,), 100)
    surfaces, calls = Surfaces(), []
    sample = surroundings.surface_points
    monkeypatch.setattr(surroundings, "surface_points", lambda mesh: calls.append(mesh) or sample(mesh))
    around = [
        points_around(np.array([0.5, x, 0.0]), [(can, np.eye(4))], [block], surfaces) for x in (-0.2, -0.1)
    ]
    assert len(calls) == 2
    np.testing.assert_array_equal(
        around[1], points_around(np.array([0.5, -0.1, 0.0]), [(can, np.eye(4))], [block])
    )
