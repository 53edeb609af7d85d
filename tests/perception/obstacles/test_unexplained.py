"""Which measured points known objects, masks and boxes explain."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.obstacles.unexplained import ExplanationConfig, KnownGeometry, unexplained_points
from perception.support.surface import SupportSurface
from perception.types import ObjectDetection, ObjectEstimate, SupportPlane, TriangleMesh

SURFACE = SupportSurface(SupportPlane())


def cylinder(x, radius=0.03, height=0.1, number=0):
    mesh = trimesh.creation.cylinder(radius, height, sections=48)
    T = np.eye(4)
    T[:3, 3] = x, 0.0, height / 2
    shape = TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return ObjectEstimate(number, "can", np.zeros(16), T, np.full(3, 0.1), shape)


@pytest.fixture(scope="module")
def scene(scenes):
    cans = [scenes.Solid(x, 0.0, 0.1, radius=0.03) for x in (-0.08, 0.08)]
    return scenes.render(cans, scenes.orbit((0, 0, 0.05), 0.5, 50, 270))


def points_beside(scene, objects, masks=(), surface=SURFACE, boxes=np.zeros((0, 2, 3))):
    return unexplained_points(scene.frame, masks, KnownGeometry.of(objects, boxes), surface)


def test_what_no_object_explains_remains(scene):
    points = points_beside(scene, [cylinder(-0.08)])
    assert len(points) > 500
    assert np.abs(np.hypot(points[:, 0] - 0.08, points[:, 1])).max() < 0.0301
    assert points[:, 2].min() > 0.009
    assert len(points_beside(scene, [cylinder(-0.08), cylinder(0.08, number=1)])) == 0


def test_a_mask_explains_up_to_its_margin(scene):
    wrong = [cylinder(-0.08), cylinder(0.08, radius=0.008, height=0.04, number=1)]
    mask = ObjectDetection("can", 0.9, scene.instances == 1, instance_id=1)
    without, with_mask = points_beside(scene, wrong), points_beside(scene, wrong, [mask])
    beside = np.hypot(with_mask[:, 0] - 0.08, with_mask[:, 1]) - 0.008
    away = np.hypot(np.maximum(beside, 0.0), np.maximum(with_mask[:, 2] - 0.04, 0.0))  # from the wrong shape
    assert len(with_mask) < 0.7 * len(without) and away.min() > ExplanationConfig().mask_margin - 1e-3
    assert len(points_beside(scene, wrong, [replace(mask, instance_id=7)])) == len(without)


def test_a_mask_does_not_explain_a_neighbour_that_it_extends_over(scene):
    """A bar across the table, in whose bounds both cans stand."""
    mesh = trimesh.creation.box((0.3, 0.01, 0.1))
    shape = TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    T = trimesh.transformations.rotation_matrix(np.pi / 4, (0, 0, 1))
    T[2, 3] = 0.05
    bar = ObjectEstimate(1, "bottle", np.zeros(16), T, np.full(3, 0.1), shape)
    mask = ObjectDetection("bottle", 0.9, scene.instances >= 0, instance_id=1)
    points = points_beside(scene, [bar], [mask])
    from_bar = np.abs(points[:, 0] - points[:, 1]) / np.sqrt(2) - 0.005
    assert len(points) > 500 and from_bar.min() > ExplanationConfig().mask_margin - 0.002


def test_boxes_and_the_edge_of_the_surface_bound_the_search(scene):
    box = np.array([[(0.05, -0.03, 0.0), (0.11, 0.03, 0.1)]])
    assert len(points_beside(scene, [cylinder(-0.08)], boxes=box)) == 0
    square = np.array([(-0.2, -0.1), (0.0, -0.1), (0.0, 0.1), (-0.2, 0.1)])
    beside = points_beside(scene, [], surface=SupportSurface(SupportPlane(), square))
    assert len(beside) and beside[:, 0].max() < 0.02


def test_what_is_in_an_upright_vessel_below_its_rim_belongs_to_it():
    solid = cylinder(0.1, radius=0.03, height=0.08)
    handle = np.array([[0.055, 0.0, 0.0]])  # along +x of the object
    mesh = TriangleMesh(np.concatenate([solid.mesh.vertices, handle]), solid.mesh.faces)
    mug = replace(solid, category="mug", mesh=mesh)
    points = np.array([(0.1, 0.0, 0.04), (0.1, 0.012, 0.075), (0.1, 0.0, 0.12), (0.147, 0.0, 0.04)])
    assert KnownGeometry.of([mug]).explains(points, 0.005).tolist() == [True, True, False, False]
    for other in (solid, replace(mug, resting="upside-down")):
        assert not KnownGeometry.of([other]).explains(points[:1], 0.005).any()


def test_an_object_occupies_its_inside_and_a_margin():
    known = KnownGeometry.of([cylinder(0.0)])
    points = np.array([(0.0, 0.0, 0.05), (0.033, 0.0, 0.05), (0.045, 0.0, 0.05), (0.0, 0.0, 0.3)])
    assert known.occupies(points, 0.008).tolist() == [True, True, False, False]
    assert not KnownGeometry.of([]).occupies(points, 0.008).any()
