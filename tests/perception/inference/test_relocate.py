"""The search for a known can on a table, in depth images drawn from dense points on known shapes."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.geometry import pose_from_yaw
from perception.inference.relocate import RelocateConfig, SearchScene, clusters, relocate, unexplained_points
from perception.metrics import SurfaceSamples
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame, TriangleMesh

CAMERA = CameraIntrinsics(160, 120, 145.0, 145.0, 79.5, 59.5)
CONFIG = RelocateConfig(stride=2, min_points=30)
REGION = ((0.0, 1.0), (-0.6, 0.2))
RADIUS, HEIGHT = 0.033, 0.12


def estimate(T=np.eye(4)):
    mesh = trimesh.creation.cylinder(RADIUS, HEIGHT, sections=48).subdivide()
    return ObjectEstimate(
        1, "can", np.zeros(16), T, np.ones(3), TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    )


def plate():
    mesh = trimesh.creation.box((1.2, 1.2, 0.001)).apply_translation((0.47, -0.2, -0.0005))
    return mesh.vertices, mesh.faces


def frames(*objects):
    """Three views of a table with objects, drawn as dense points, without noise."""
    rng = np.random.default_rng(0)
    table = TriangleMesh(*(np.asarray(a) for a in plate()))
    surface = np.concatenate(
        [SurfaceSamples.of(mesh, rng, 150_000).points for mesh in (table, *(o.mesh_world for o in objects))]
    )
    views = []
    for azimuth, elevation in ((90, 80), (30, 50), (200, 50)):
        a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
        outward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        x = np.array([-np.sin(a), np.cos(a), 0.0])
        T = np.eye(4)
        T[:3, :3] = np.stack([x, np.cross(-outward, x), -outward], axis=1)
        T[:3, 3] = np.array([0.47, -0.2, 0.03]) + 0.55 * outward
        seen = (surface - T[:3, 3]) @ T[:3, :3]
        u = np.rint(CAMERA.fx * seen[:, 0] / seen[:, 2] + CAMERA.cx).astype(int)
        v = np.rint(CAMERA.fy * seen[:, 1] / seen[:, 2] + CAMERA.cy).astype(int)
        inside = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
        depth = np.full((120, 160), np.inf, np.float32)
        np.minimum.at(depth, (v[inside], u[inside]), seen[inside, 2].astype(np.float32))
        depth[np.isinf(depth)] = 0
        views.append(RgbdFrame(0.0, np.zeros((120, 160, 3), np.uint8), depth, CAMERA, T))
    return views


def lying(azimuth, x, y):
    T = pose_from_yaw(azimuth, np.array([x, y, RADIUS]))
    T[:3, :3] = T[:3, :3] @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    return T


def upright(x, y):
    return pose_from_yaw(0.0, np.array([x, y, HEIGHT / 2]))


@pytest.mark.slow
@pytest.mark.parametrize("T", [lying(0.7, 0.5, -0.25), upright(0.42, -0.12)])
def test_a_known_object_is_found_lying_and_standing(T):
    other = estimate(upright(0.6, -0.1))
    views = frames(estimate(T), other)
    check = relocate(estimate(), SearchScene(views, REGION, [other]), CONFIG)
    assert check is not None
    np.testing.assert_allclose(check.T_world_object[:2, 3], T[:2, 3], atol=0.006)
    assert abs(check.T_world_object[:3, 2] @ T[:3, 2]) > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("azimuth", [0.7, 0.7 + np.pi])
def test_a_can_that_was_knocked_over_lies_with_its_base_where_it_stood(azimuth):
    T = lying(azimuth, 0.5, -0.25)
    before = upright(*(T[:2, 3] - 0.5 * HEIGHT * T[:2, 2]))
    check = relocate(estimate(), SearchScene(frames(estimate(T)), REGION), CONFIG, before)
    assert check is not None and check.T_world_object[:3, 2] @ T[:3, 2] > 0.99


@pytest.mark.slow
def test_nothing_is_found_on_an_empty_table_or_in_another_shape():
    other = estimate(upright(0.6, -0.1))
    assert relocate(estimate(), SearchScene(frames(other), REGION, [other]), CONFIG) is None
    flat = trimesh.creation.box((0.14, 0.10, 0.03))
    thing = replace(
        estimate(pose_from_yaw(0.2, np.array([0.45, -0.25, 0.015]))),
        mesh=TriangleMesh(np.asarray(flat.vertices), np.asarray(flat.faces)),
    )
    assert relocate(estimate(), SearchScene(frames(thing, other), REGION, [other]), CONFIG) is None


def test_points_are_grouped_by_touching_cells():
    near = np.random.default_rng(0).uniform(0, 0.05, (200, 3))
    far = near[:100] + np.array([0.2, 0.0, 0.0])
    groups = clusters(np.concatenate([far, near]), RelocateConfig(min_points=50))
    assert [len(group) for group in groups] == [200, 100]
    assert len(clusters(np.concatenate([far, near]), RelocateConfig(min_points=150))) == 1
    assert clusters(np.zeros((0, 3))) == []


def test_things_of_no_class_explain_depth():
    can, thing = estimate(upright(0.45, -0.25)), estimate(upright(0.6, -0.1))
    views = frames(can, thing)
    obstacle = PerceivedObstacle(1, (thing.mesh_world.vertices,), 500)
    points = unexplained_points(SearchScene(views, REGION, obstacles=[obstacle]), CONFIG)
    both = unexplained_points(SearchScene(views, REGION), CONFIG)
    assert 0 < len(points) < len(both)
    assert np.linalg.norm(points[:, :2] - (0.45, -0.25), axis=1).max() < RADIUS + 0.01


def test_without_images_there_are_no_points():
    assert len(unexplained_points(SearchScene([], REGION))) == 0
