"""Candidates for the pose of a can whose depth images are drawn from points on known shapes."""

import numpy as np
import pytest

from perception.inference.depth_votes import DepthVotes, SearchScene
from perception.inference.pose_candidates import CandidateConfig, pose_candidates
from tests.perception.inference.drawn_cans import HEIGHT, REGION, drawn, estimate, lying, upright


def candidates(*objects, others=(), config=CandidateConfig()):
    scene = SearchScene(drawn(*objects), REGION, others)
    votes = DepthVotes.of(scene, stride=2, min_height=0.012, explained=0.012)
    return pose_candidates(estimate(), votes, config=config)


def leaning(lean, x, y, z):
    T = lying(0.4, x, y, z)
    c, s = np.cos(lean), np.sin(lean)
    T[:3, :3] = T[:3, :3] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return T


@pytest.mark.parametrize(
    "T", [upright(0.43, -0.18), lying(0.7, 0.5, -0.25), leaning(-0.45, 0.5, -0.2, 0.075)]
)
def test_the_best_candidate_is_near_the_true_pose(T):
    best = candidates(estimate(T))[0].T_world_object
    assert np.linalg.norm(best[:3, 3] - T[:3, 3]) < 0.02
    assert abs(best[:3, 2] @ T[:3, 2]) > np.cos(np.deg2rad(20))


def test_a_can_that_stands_on_another_is_found_at_its_height():
    below = estimate(upright(0.45, -0.25))
    T = upright(0.45, -0.25, 1.5 * HEIGHT)
    best = candidates(estimate(T), below, others=[below])[0].T_world_object
    np.testing.assert_allclose(best[:3, 3], T[:3, 3], atol=0.015)


def test_candidates_differ_and_are_sorted():
    found = candidates(estimate(upright(0.40, -0.30)), estimate(upright(0.55, -0.15)))
    assert [c.score for c in found] == sorted((c.score for c in found), reverse=True)
    assert len(found) <= CandidateConfig().n_fine
    distance, angle = CandidateConfig().fine_apart
    poses = [c.T_world_object for c in found]
    for i, T in enumerate(poses):
        for S in poses[:i]:
            apart = np.linalg.norm(T[:3, 3] - S[:3, 3])
            assert apart >= distance or np.arccos(np.clip(T[:3, 2] @ S[:3, 2], -1, 1)) >= angle
    places = {tuple(np.round(T[:2, 3] / 0.15).astype(int)) for T in poses}
    assert len(places) == 2


def test_an_empty_table_has_none():
    assert candidates() == []
