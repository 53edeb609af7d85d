"""Obstacles of boxes rendered in closed form: extent, known objects, free space, hidden space, noise."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from perception.obstacles.find import find_obstacles, plane_frame
from perception.support.surface import SupportSurface
from perception.types import ObjectDetection, ObjectEstimate, SupportPlane, TriangleMesh

SURFACE = SupportSurface(SupportPlane())
VOXEL = 0.005
AROUND = [(55, 0), (55, 120), (55, 240), (88, 0)]  # elevation, azimuth of the views [deg]


def look(scenes, solids, views=AROUND, noise=0.0):
    return [scenes.render(solids, scenes.orbit((0, 0, 0.05), 0.55, *view), noise) for view in views]


def obstacles_of(rendered, objects=(), masks=None, **kwargs):
    frames = [scene.frame for scene in rendered]
    return find_obstacles(frames, masks or [[] for _ in frames], objects, SURFACE, **kwargs)


def box_estimate(solid, number=0):
    x, y, h = solid.half[0], solid.half[1], solid.height
    corners = np.array([(a, b, c) for a in (-x, x) for b in (-y, y) for c in (-h / 2, h / 2)])
    hull = ConvexHull(corners)
    faces = hull.simplices.copy()
    a, b, c = (corners[faces[:, i]] for i in range(3))
    inward = (np.cross(b - a, c - a) * a).sum(1) < 0
    faces[inward] = faces[inward][:, ::-1]
    T = np.eye(4)
    T[:3, 3] = solid.x, solid.y, h / 2
    return ObjectEstimate(number, "can", np.zeros(16), T, np.full(3, 0.1), TriangleMesh(corners, faces))


@pytest.fixture(scope="module")
def box(scenes):
    return scenes.Solid(0.02, -0.01, 0.08, half=(0.04, 0.025))


@pytest.mark.parametrize(("views", "noise"), [(AROUND, 0.0), (AROUND, 0.0015), ([(50, 20), (50, 200)], 0.0)])
def test_a_box_is_found_within_a_voxel(scenes, box, views, noise):
    (found,) = obstacles_of(look(scenes, [box], views, noise))
    low, high = found.bounds
    tolerance = VOXEL + 3 * noise
    np.testing.assert_allclose(low, (-0.02, -0.035, 0.0), atol=tolerance)
    np.testing.assert_allclose(high, (0.06, 0.015, 0.08), atol=tolerance)
    assert len(found.pieces) == 1


def test_a_bare_table_has_no_obstacle_whatever_the_noise(scenes):
    assert obstacles_of(look(scenes, [], noise=0.003)) == []


def test_an_estimated_object_is_no_obstacle_and_its_neighbour_is(scenes, box):
    other = scenes.Solid(-0.07, -0.01, 0.06, half=(0.02, 0.02))
    rendered = look(scenes, [box, other])
    assert obstacles_of(rendered, [box_estimate(box), box_estimate(other, 1)]) == []
    (found,) = obstacles_of(rendered, [box_estimate(box)])
    assert found.bounds[1, 0] == pytest.approx(-0.05, abs=VOXEL)


def test_a_mask_explains_what_a_wrong_shape_does_not(scenes, box):
    too_small = scenes.Solid(box.x, box.y, 0.05, half=(0.04, 0.025))
    rendered = look(scenes, [box])
    masks = [[ObjectDetection("can", 0.9, scene.instances == 0, instance_id=0)] for scene in rendered]
    assert len(obstacles_of(rendered, [box_estimate(too_small)])) == 1
    assert obstacles_of(rendered, [box_estimate(too_small)], masks) == []


def test_a_known_box_is_no_obstacle(scenes, box):
    known = np.array([[(-0.02, -0.035, 0.0), (0.06, 0.015, 0.08)]])
    assert obstacles_of(look(scenes, [box]), boxes=known) == []


def test_a_touching_object_stays_outside_the_pieces(scenes, box):
    """Hidden space between a thing and an object is the thing's, but for a clearance."""
    neighbour = scenes.Solid(0.10, -0.01, 0.08, half=(0.04, 0.025))
    (found,) = obstacles_of(look(scenes, [box, neighbour]), [box_estimate(neighbour)])
    assert 0.04 < found.bounds[1, 0] <= 0.06 - 0.005
    assert found.bounds[0, 0] == pytest.approx(-0.02, abs=VOXEL)


def test_free_space_between_two_legs_is_no_obstacle(scenes):
    """A bridge of two towers and a beam: the convex hull would fill the opening, the pieces do not."""
    legs = [scenes.Solid(x, 0.0, 0.08, half=(0.012, 0.02)) for x in (-0.08, 0.08)]
    beam = scenes.Solid(0.0, 0.0, 0.02, half=(0.092, 0.02), bottom=0.08)
    views = [*AROUND, (20, 80), (20, 270)]
    (found,) = obstacles_of(look(scenes, [*legs, beam], views))
    opening = np.array([(x, y, z) for x in (-0.04, 0.0, 0.04) for y in (-0.01, 0.01) for z in (0.02, 0.05)])
    assert len(found.pieces) > 1
    for piece in found.pieces:
        hull = ConvexHull(piece)
        assert not (opening @ hull.equations[:, :3].T + hull.equations[:, 3] < 0).all(1).any()


def test_what_one_view_does_not_show_is_part_of_the_thing_up_to_a_limit(scenes, box):
    (found,) = obstacles_of(look(scenes, [box], [(40, 0)]))  # the side at small x is not seen
    assert -0.02 - 0.045 < found.bounds[0, 0] < -0.02 + VOXEL


def test_the_frame_of_a_plane_stands_on_it():
    plane = SupportPlane(np.array([0.0, 0.6, 0.8]), 0.3)
    T = plane_frame(plane)
    np.testing.assert_allclose(plane.height_above((T @ (0.1, 0.2, 0.05, 1.0))[None, :3]), 0.05, atol=1e-12)
