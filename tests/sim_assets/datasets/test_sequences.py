"""Sequences move smoothly, repeat with their seed, and their truth is true."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from sim_assets.cell.layout import PlanarPose
from sim_assets.cell.outlines import gap, outline
from sim_assets.datasets import sequences
from sim_assets.datasets.sequences import (
    CLOSE_UP,
    SequenceConfig,
    TableSequence,
    perturbed_poses,
    sample_trajectory,
)

SMALL = SequenceConfig(width=80, height=60, frames=2, objects=3)


def turn_between(A, B):
    return np.arccos(np.clip((np.trace(A[:3, :3].T @ B[:3, :3]) - 1) / 2, -1, 1))


@pytest.mark.parametrize("config", [replace(SequenceConfig(), frames=80), CLOSE_UP])
def test_no_frame_is_farther_from_the_last_than_allowed(config):
    Ts = sample_trajectory(config, np.random.default_rng(1))
    assert len(Ts) == config.frames
    moves = np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1)
    turns = np.array([turn_between(A, B) for A, B in pairwise(Ts)])
    assert moves.max() < 1.3 * config.step and turns.max() < 1.3 * config.turn
    assert np.maximum(moves / config.step, turns / config.turn).min() > 0.7  # and none stands still
    assert (Ts[:, 2, 3] > 0.1).all()  # over the table


def test_same_seed_same_sequence():
    first, second = (TableSequence(4, SMALL) for _ in range(2))
    for a, b in zip(first.render(), second.render()):
        np.testing.assert_array_equal(a.frame.rgb, b.frame.rgb)
        np.testing.assert_array_equal(a.frame.depth, b.frame.depth)
    other = next(iter(TableSequence(5, SMALL).render()))
    assert not np.array_equal(a.frame.depth, other.frame.depth)


def test_truth_agrees_with_the_images():
    sequence = TableSequence(2, replace(SMALL, depth_noise="none"))
    image = next(iter(sequence.render()))
    frame, k = image.frame, image.frame.intrinsics
    for index, item in enumerate(sequence.objects):
        v, u = np.nonzero(image.instances == index)
        if len(v) < 20:
            continue
        z = frame.depth[v, u]
        camera = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z, np.ones(len(z))])
        points = (np.linalg.inv(item.T_world_object) @ frame.T_world_camera @ camera)[:3].T
        low, high = item.model.mesh.bounds
        assert (points > low - 0.003).all() and (points < high + 0.003).all()
    assert {item.model.split for item in sequence.objects} == {"test"}


def test_pose_noise_is_as_large_as_asked():
    noisy = perturbed_poses(
        np.tile(np.eye(4), (2000, 1, 1)), np.random.default_rng(0), 0.001, np.radians(0.1)
    )
    assert noisy[:, :3, 3].std(axis=0) == pytest.approx(np.full(3, 0.001), rel=0.1)
    about_x = np.arctan2(noisy[:, 2, 1], noisy[:, 2, 2])
    assert about_x.std() == pytest.approx(np.radians(0.1), rel=0.1)
    np.testing.assert_allclose(
        noisy[:, :3, :3] @ np.swapaxes(noisy[:, :3, :3], 1, 2), np.tile(np.eye(3), (2000, 1, 1)), atol=1e-9
    )


def test_a_hand_moves_one_object_and_no_other():
    still = TableSequence(7, replace(SMALL, frames=3))
    sequence = TableSequence(7, replace(SMALL, frames=3, moved_at=1))
    assert still.moved is None and sequence.moved is not None
    for index, (before, after) in enumerate(zip(still.objects, sequence.objects)):
        gap = np.linalg.norm(before.T_world_object[:3, 3] - after.T_world_object[:3, 3])
        assert 0.08 < gap < 0.15 if index == sequence.moved else gap == 0
    images, unmoved = list(sequence.render()), list(still.render())
    np.testing.assert_array_equal(images[0].instances, unmoved[0].instances)
    assert not np.array_equal(images[1].instances, unmoved[1].instances)
    np.testing.assert_array_equal(images[1].instances, next(iter_from(sequence, 1)).instances)


def iter_from(sequence, number):
    """A second rendering, from one image on: it begins with the object where it was."""
    images = sequence.render()
    for _ in range(number):
        next(images)
    return images


def test_configuration_is_followed():
    """Gap, square, noise, rate and classes of a sampled sequence."""
    config = replace(SMALL, objects=5, spread=0.2, gap=0.05)
    sequence = TableSequence(11, config)
    polygons, places = [], []
    for item in sequence.objects:
        yaw = np.arctan2(item.T_world_object[1, 0], item.T_world_object[0, 0])
        places.append(item.T_world_object[:2, 3])
        polygons.append(PlanarPose(*places[-1], yaw).transform(outline(item.model.mesh)))
    assert np.abs(places).max() <= 0.2
    assert min(gap(a, b) for i, a in enumerate(polygons) for b in polygons[:i]) >= 0.05
    assert [item.model.category for item in sequence.objects] == ["mug", "bowl", "bottle", "mug", "bowl"]
    noisy = list(sequence.render())
    exact = list(TableSequence(11, replace(config, depth_noise="none")).render())
    assert np.std(noisy[0].frame.depth - exact[0].frame.depth) == pytest.approx(0.002, rel=0.1)
    assert noisy[1].frame.time == pytest.approx(1 / 30)


def test_camera_keeps_its_distance_and_elevation_at_the_knots(monkeypatch):
    """Of the sampled positions, before interpolation."""
    knots = []

    def spline(at, values):
        knots.append(np.array(values))
        return CubicSpline(at, values)

    monkeypatch.setattr(sequences, "CubicSpline", spline)
    config = SequenceConfig(frames=60)
    sample_trajectory(config, np.random.default_rng(3))
    away = knots[-2] - knots[-1]  # positions less look-at points
    distance = np.linalg.norm(away, axis=1)
    assert (distance >= config.distance[0]).all() and (distance <= config.distance[1]).all()
    elevation = np.arcsin(away[:, 2] / distance)
    assert (elevation >= config.elevation[0] - 1e-9).all() and (elevation <= config.elevation[1] + 1e-9).all()
    assert np.abs(knots[-1][:, :2]).max() <= config.look_at
