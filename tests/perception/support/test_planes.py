"""Candidate planes of scenes in closed form, and their refinement."""

from dataclasses import replace

import numpy as np
import pytest

from perception.support.planes import PlaneConfig, candidate_planes, on_plane, refined, tolerance
from perception.support.samples import sample_frames
from perception.types import SupportPlane

CONFIG = PlaneConfig()
UP = np.array([0.0, 0.0, 1.0])


def samples_of(scenes, solids, eye=(0, -0.7, 0.6), target=(0, 0.1, 0.0), noise=0.002):
    frame = scenes.render(solids, scenes.look_at(eye, target), noise).frame
    return sample_frames([frame], CONFIG.max_points, CONFIG.max_depth)


def test_planes_come_by_their_number_of_samples(scenes):
    solids = [scenes.Solid(0, 0.1, 0.12, half=(0.2, 0.15)), scenes.Solid(0.1, 0.15, 0.2, half=(0.1, 0.1))]
    planes = candidate_planes(samples_of(scenes, solids), True, CONFIG, np.random.default_rng(0))
    heights = [plane.offset for plane in planes[:3]]
    assert heights == pytest.approx([0.0, 0.12, 0.2], abs=1e-3)
    assert all(plane.normal @ UP > np.cos(0.01) for plane in planes[:3])


def test_walls_are_candidates_only_without_a_pose(scenes):
    solids = [scenes.Solid(0, 0.5, 2.0, half=(2.0, 0.01))]
    samples = samples_of(scenes, solids, target=(0, 0.3, 0.2))
    unposed = candidate_planes(samples, False, CONFIG, np.random.default_rng(0))
    assert any(abs(plane.normal @ UP) < 0.05 for plane in unposed)
    posed = candidate_planes(samples, True, CONFIG, np.random.default_rng(0))
    assert posed and all(plane.normal @ UP > np.cos(CONFIG.max_tilt) for plane in posed)


def test_a_volume_without_surfaces_has_no_plane(scenes):
    frame = scenes.render([], scenes.look_at((0, -0.5, 0.5), (0, 0, 0))).frame
    depth = np.random.default_rng(0).uniform(0.3, 2.5, frame.depth.shape).astype(np.float32)
    samples = sample_frames([replace(frame, depth=depth)], CONFIG.max_points, CONFIG.max_depth)
    assert candidate_planes(samples, False, CONFIG, np.random.default_rng(0)) == []


def test_refinement_is_total_least_squares_on_inliers(scenes):
    samples = samples_of(scenes, [scenes.Solid(0, 0.1, 0.02, half=(0.2, 0.15))])
    tilted = np.array([0.01, 0.0, 1.0])
    plane = refined(samples, SupportPlane(tilted / np.linalg.norm(tilted), 0.003), CONFIG)
    assert np.degrees(np.arccos(plane.normal @ UP)) < 0.05 and plane.offset == pytest.approx(0, abs=3e-4)
    left = samples.points[:, 0] < 0
    half = refined(samples, plane, CONFIG, among=left)
    assert 0 < np.degrees(np.arccos(half.normal @ plane.normal)) < 0.1


def test_the_tolerance_grows_with_the_noise_of_distant_samples(scenes):
    samples = samples_of(scenes, [])
    wide = tolerance(samples, CONFIG)
    near, far = samples.depth < 0.9, samples.depth > 1.5
    np.testing.assert_allclose(wide[near], CONFIG.threshold, rtol=1e-6)
    assert (wide[far] > 1.5 * CONFIG.threshold).all()


def test_samples_of_a_side_that_the_plane_cuts_are_not_on_it(scenes):
    samples = samples_of(scenes, [scenes.Solid(0, 0.1, 0.3, half=(0.2, 0.1))], noise=0.0)
    inside, height = on_plane(samples, SupportPlane(offset=0.15), CONFIG)
    assert (np.abs(height) < CONFIG.threshold).sum() > 50  # a strip of the front
    assert inside.sum() < 5
