"""Samples of planes of known normal; the noise model at the figures of its source."""

from dataclasses import replace

import numpy as np
import pytest

from perception.support.samples import depth_noise, sample_frames

POSE = ((0.1, -0.5, 0.5), (0.1, 0.2, 0.0))


def test_samples_are_points_and_normals_of_the_surfaces(scenes):
    frame = scenes.render([scenes.Solid(0.1, 0.1, 0.1, half=(0.1, 0.05))], scenes.look_at(*POSE)).frame
    samples = sample_frames([frame], 5000, 3.0)
    (shape,) = samples.shapes
    assert shape[0] * shape[1] == len(samples.points) and 4000 < len(samples.points) < 6000
    assert samples.valid.all()
    table = np.abs(samples.points[:, 2]) < 1e-3
    top = np.abs(samples.points[:, 2] - 0.1) < 1e-3
    assert 0.6 < table.mean() < 0.99 and top.sum() > 50
    flat = (table | top) & (samples.normals != 0).any(1)
    assert np.median(samples.normals[flat] @ np.array([0.0, 0.0, 1.0])) > 0.999


def test_normals_are_towards_the_camera_and_unknown_beside_missing_depth(scenes):
    frame = scenes.render([], scenes.look_at(*POSE)).frame
    depth = np.array(frame.depth)
    depth[100:140, 100:140] = 0
    samples = sample_frames([replace(frame, depth=depth)], 5000, 3.0)
    ((rows, columns),) = samples.shapes
    known = (samples.normals != 0).any(1).reshape(rows, columns)
    hole = ~samples.valid.reshape(rows, columns)
    row, column = np.argwhere(hole).mean(0).round().astype(int)
    assert hole.any() and not known[hole].any()
    assert not known[row, column - hole[row].sum() // 2 - 1] and known[row, 3]
    rays = samples.points - samples.centres[0]
    assert ((samples.normals * rays).sum(1)[known.ravel()] < 0).all()


def test_depth_beyond_the_limit_is_not_sampled_and_frames_are_told_apart(scenes):
    near = scenes.render([], scenes.look_at(*POSE)).frame
    far = replace(near, depth=near.depth + np.float32(4.0))
    samples = sample_frames([near, far], 2000, 3.0)
    assert samples.valid[samples.view == 0].all() and not samples.valid[samples.view == 1].any()
    assert samples.centres.shape == (2, 3)


def test_neighbours_are_of_the_same_frame(scenes):
    frame = scenes.render([], scenes.look_at(*POSE)).frame
    samples = sample_frames([frame, frame], 2000, 3.0)
    rows, columns = samples.shapes[0]
    chosen = np.zeros(len(samples.valid), bool)
    chosen[rows * columns - 1] = True  # the last sample of the first frame
    grown = samples.beside(chosen)
    assert grown.sum() == 4 and not grown[rows * columns :].any()


@pytest.mark.parametrize(("depth", "sigma"), [(0.4, 0.0012), (1.4, 0.0031), (2.4, 0.0088)])
def test_noise_grows_with_the_square_of_the_depth(depth, sigma):
    assert depth_noise(np.array(depth)) == pytest.approx(sigma)
