"""The search for a known can on a table, in depth images drawn from dense points on known shapes."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.geometry import pose_from_yaw
from perception.inference import relocate as module
from perception.inference.depth_votes import SearchScene
from perception.inference.pose_candidates import Candidate
from perception.inference.relocate import RelocateConfig, relocate
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import TriangleMesh
from tests.perception.inference.drawn_cans import HEIGHT, RADIUS, REGION, drawn, estimate, lying, upright

CONFIG = RelocateConfig(stride=2, min_points=30)


@pytest.mark.slow
@pytest.mark.parametrize("T", [lying(0.7, 0.5, -0.25), upright(0.42, -0.12)])
def test_a_known_object_is_found_lying_and_standing(T):
    other = estimate(upright(0.6, -0.1))
    views = drawn(estimate(T), other)
    check = relocate(estimate(), SearchScene(views, REGION, [other]), CONFIG)
    assert check is not None
    np.testing.assert_allclose(check.T_world_object[:2, 3], T[:2, 3], atol=0.006)
    assert abs(check.T_world_object[:3, 2] @ T[:3, 2]) > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("azimuth", [0.7, 0.7 + np.pi])
def test_a_can_that_was_knocked_over_lies_with_its_base_where_it_stood(azimuth):
    T = lying(azimuth, 0.5, -0.25)
    before = upright(*(T[:2, 3] - 0.5 * HEIGHT * T[:2, 2]))
    check = relocate(estimate(), SearchScene(drawn(estimate(T)), REGION), CONFIG, before)
    assert check is not None and check.T_world_object[:3, 2] @ T[:3, 2] > 0.99


def test_a_pose_that_the_search_missed_is_found_as_the_reverse_of_another(monkeypatch):
    """Both ways round look alike; the base is where it was."""
    T = lying(0.7, 0.5, -0.25)
    the_other_way = T @ np.diag([1.0, -1.0, -1.0, 1.0])
    monkeypatch.setattr(module, "pose_candidates", lambda *args: [Candidate(1.0, the_other_way)])
    check = relocate(estimate(), SearchScene(drawn(estimate(T)), REGION), CONFIG, T)
    assert check is not None and check.T_world_object[:3, 2] @ T[:3, 2] > 0.99
    np.testing.assert_allclose(check.T_world_object[:3, 3], T[:3, 3], atol=0.006)


@pytest.mark.slow
def test_nothing_is_found_on_an_empty_table_or_in_another_shape():
    other = estimate(upright(0.6, -0.1))
    assert relocate(estimate(), SearchScene(drawn(other), REGION, [other]), CONFIG) is None
    flat = trimesh.creation.box((0.14, 0.10, 0.03))
    thing = replace(
        estimate(pose_from_yaw(0.2, np.array([0.45, -0.25, 0.015]))),
        mesh=TriangleMesh(np.asarray(flat.vertices), np.asarray(flat.faces)),
    )
    assert relocate(estimate(), SearchScene(drawn(thing, other), REGION, [other]), CONFIG) is None


@pytest.mark.slow
def test_a_can_is_found_between_things_that_it_touches():
    thing = trimesh.creation.box((0.10, 0.05, 0.15))
    box = TriangleMesh(np.asarray(thing.vertices), np.asarray(thing.faces))
    beside = estimate(pose_from_yaw(0.0, np.array([0.45, -0.25 - RADIUS - 0.025, 0.075])), box)
    T = upright(0.45, -0.25)
    obstacle = PerceivedObstacle(1, (beside.mesh_world.vertices,), 500)
    scene = SearchScene(drawn(estimate(T), beside), REGION, obstacles=[obstacle])
    check = relocate(estimate(), scene, CONFIG)
    assert check is not None
    np.testing.assert_allclose(check.T_world_object[:3, 3], T[:3, 3], atol=0.006)


@pytest.mark.slow
def test_a_can_that_lies_on_another_is_found():
    below, T = estimate(lying(0.2, 0.45, -0.2)), lying(1.6, 0.46, -0.2, 3 * RADIUS)
    scene = SearchScene(drawn(estimate(T), below), REGION, [below])
    check = relocate(estimate(), scene, CONFIG)
    assert check is not None
    np.testing.assert_allclose(check.T_world_object[:3, 3], T[:3, 3], atol=0.008)


@pytest.mark.slow
def test_a_can_is_not_found_in_a_part_of_something_larger():
    tall = trimesh.creation.box((0.16, 0.12, 0.2))
    mesh = TriangleMesh(np.asarray(tall.vertices), np.asarray(tall.faces))
    scene = SearchScene(drawn(estimate(upright(0.45, -0.25, 0.1), mesh)), REGION)
    assert relocate(estimate(), scene, CONFIG) is None
