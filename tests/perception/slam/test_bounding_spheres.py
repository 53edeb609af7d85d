"""Bounding spheres in the camera frame."""

import numpy as np
import pytest

from perception.geometry import transform_points
from perception.slam.bounding_spheres import BoundingSpheres


def test_spheres_of_a_map_in_the_camera_frame(cylinders, T_view):
    world = cylinders.map()
    spheres = BoundingSpheres.of(world, T_view, margin=0.01)
    centres = np.array([world.landmarks[id].state.pose.translation for id in world.ids])
    np.testing.assert_allclose(transform_points(T_view, spheres.centres), centres, atol=1e-12)
    radii = [world.landmarks[id].bounding_radius + 0.01 for id in world.ids]
    assert spheres.radii == pytest.approx(radii)


def test_an_empty_map_has_no_spheres(cylinders, T_view):
    spheres = BoundingSpheres.of(cylinders.map().without(set(range(5))), T_view)
    assert spheres.depth_range.shape == (0, 2) and spheres.hit_by(np.ones((3, 3))).shape == (3, 0)


def test_depth_ranges_end_at_the_spheres_in_front_of_the_camera():
    spheres = BoundingSpheres(np.array([[0, 0, 1.0], [0, 0, 0.1], [0, 0, -1.0]]), np.array([0.2, 0.3, 0.1]))
    np.testing.assert_allclose(spheres.depth_range, [[0.8, 1.2], [0.02, 0.4], [0.02, 0.05]])


def test_rays_hit_spheres_in_front_of_the_camera():
    spheres = BoundingSpheres(np.array([[0.1, 0, 1.0], [0, 0, -1.0]]), np.array([0.101, 0.2]))
    rays = np.array([[0, 0, 1.0], [0.1, 0, 1.0], [-0.01, 0, 1.0], [0.25, 0, 1.0]])
    assert spheres.hit_by(rays).tolist() == [[True, False], [True, False], [False, False], [False, False]]
