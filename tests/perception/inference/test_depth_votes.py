"""Votes of depth images on the pose of a can, in images drawn from dense points on known shapes."""

import numpy as np
import pytest
import trimesh

from perception.geometry import pose_from_yaw
from perception.inference.depth_votes import DepthVotes, SearchScene, VisibleSamples
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import TriangleMesh
from tests.perception.inference.drawn_cans import HEIGHT, RADIUS, REGION, drawn, estimate, upright


def votes_of(frames, **known):
    return DepthVotes.of(SearchScene(frames, REGION, **known), stride=2, min_height=0.012, explained=0.012)


def score(votes, T, samples=None):
    samples = samples or VisibleSamples(estimate().mesh, 600)
    return float(votes.score(samples, T[:3, :3], T[None, :3, 3], near=0.01)[0])


def test_of_a_box_the_faces_toward_the_camera_are_seen():
    box = trimesh.creation.box((0.1, 0.1, 0.1)).subdivide().subdivide()
    samples = VisibleSamples(TriangleMesh(np.asarray(box.vertices), np.asarray(box.faces)), 900)
    from_above, from_corner = samples.seen_from(np.array([[0.0, 0, 1], [1.0, 1, 1]]))
    on_top = samples.points[:, 2] > 0.04999
    assert np.array_equal(from_above, on_top)
    faces = (samples.points > 0.04999).any(axis=1)
    np.testing.assert_array_equal(from_corner, faces)


def test_of_a_cup_the_inside_is_seen_from_above_alone():
    outer, inner = (trimesh.creation.cylinder(r, 0.1, sections=48) for r in (0.040, 0.036))
    inner.apply_translation((0, 0, 0.005))
    cup = trimesh.boolean.difference([outer, inner], engine="manifold")
    samples = VisibleSamples(TriangleMesh(np.asarray(cup.vertices), np.asarray(cup.faces)), 3000)
    x, y, z = samples.points.T
    floor = (np.abs(z + 0.045) < 1e-4) & (np.hypot(x, y) < 0.02)
    above, aside = samples.seen_from(np.array([[0.0, 0, 1], [1.0, 0, 0.1]]))
    assert floor.sum() > 10 and above[floor].all() and not aside[floor].any()


def test_the_true_pose_scores_high_and_falls_with_the_distance_from_it():
    T = upright(0.45, -0.25)
    votes = votes_of(drawn(estimate(T)))
    scores = [score(votes, upright(0.45 + d, -0.25)) for d in (0.0, 0.01, 0.02, 0.04)]
    assert scores[0] > 0.8 and scores == sorted(scores, reverse=True)
    assert scores[-1] < 0


def test_where_nothing_is_all_points_are_against_the_pose():
    votes = votes_of(drawn(estimate(upright(0.6, -0.1))))
    assert score(votes, upright(0.40, -0.35)) < -0.8


def test_inside_a_larger_thing_a_pose_is_covered():
    tall = trimesh.creation.box((0.12, 0.12, 0.2))
    thing = TriangleMesh(np.asarray(tall.vertices), np.asarray(tall.faces))
    views = drawn(estimate(pose_from_yaw(0.3, np.array([0.45, -0.25, 0.1])), thing))
    assert abs(score(votes_of(views), upright(0.45, -0.25))) < 0.05


def test_what_another_object_hides_does_not_count():
    can, other = estimate(upright(0.45, -0.25)), estimate(upright(0.45 + 2.2 * RADIUS, -0.25))
    frames = drawn(can, other)
    known, unknown = votes_of(frames, others=[other]), votes_of(frames)
    assert score(known, can.T_world_object) > score(unknown, can.T_world_object) - 1e-9
    assert score(known, other.T_world_object) < 0.2 < score(unknown, other.T_world_object)


def test_things_of_no_class_explain_depth():
    can, thing = estimate(upright(0.45, -0.25)), estimate(upright(0.6, -0.1))
    views = drawn(can, thing)
    obstacle = PerceivedObstacle(1, (thing.mesh_world.vertices,), 500)
    points, both = votes_of(views, obstacles=[obstacle]).points, votes_of(views).points
    assert 0 < len(points) < len(both)
    assert np.linalg.norm(points[:, :2] - (0.45, -0.25), axis=1).max() < RADIUS + 0.01


def test_flat_things_of_no_class_explain_depth_too():
    """A piece without volume has no convex hull."""
    views = drawn(estimate(upright(0.45, -0.25)))
    sheet = np.array([[0.6, -0.1, 0.02], [0.7, -0.1, 0.02], [0.7, 0.0, 0.02], [0.6, 0.0, 0.02]])
    points = votes_of(views, obstacles=[PerceivedObstacle(1, (sheet,), 500)]).points
    assert len(points) == len(votes_of(views).points) > 0


def test_in_widened_images_a_pose_beside_the_right_one_has_less_against_it():
    votes = votes_of(drawn(estimate(upright(0.45, -0.25))))
    beside = upright(0.459, -0.25)
    assert score(votes.widened(0.012), beside) > score(votes, beside) + 0.03
    assert score(votes.widened(0.012), upright(0.40, -0.35)) < -0.6


def test_without_images_there_are_no_points():
    assert len(votes_of([]).points) == 0


@pytest.mark.parametrize("height", [0.012, HEIGHT / 2])
def test_points_below_the_least_height_are_of_the_support(height):
    scene = SearchScene(drawn(estimate(upright(0.45, -0.25))), REGION)
    points = DepthVotes.of(scene, stride=2, min_height=height, explained=0.012).points
    assert len(points) > 0 and points[:, 2].min() > height
