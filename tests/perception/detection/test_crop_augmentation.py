"""Augmentation of training crops."""

import numpy as np
import torch

from perception.detection.crop_augmentation import (
    Draws,
    mirror_crops,
    perturb_crops,
    truncate_crops,
    vary_colours,
    warp_crops,
)
from perception.detection.crop_network import normalise_crops
from perception.detection.crop_training import CropSet
from perception.detection.crops import SIDE
from perception.detection.yaw import bin_centres, soft_labels


def seeded(count, rows=slice(None)):
    return Draws(torch.Generator().manual_seed(0), count, rows)


def notched_discs(count):
    """Return crops of discs with a notch in the direction of the yaw, with yaw targets, and the yaws."""
    rng = np.random.default_rng(0)
    yaw = rng.uniform(0, 2 * np.pi, count)
    v, u = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    images = np.zeros((count, SIDE, SIDE, 6), np.uint8)
    for image, angle in zip(images, yaw):
        # Counted from up in the crop, counter-clockwise: up is -v, left is -u.
        notch = np.hypot(u + 22 * np.sin(angle), v + 22 * np.cos(angle)) < 8
        shape = (np.hypot(u, v) < 20) | notch
        image[shape] = (rng.integers(80, 255), 0, 0, 255, 100, 127)
    return CropSet(images, np.zeros((count, 2), np.float32), soft_labels(yaw)), yaw


def test_mirroring_a_crop_negates_its_yaw():
    crops, yaw = notched_discs(40)
    images, targets = mirror_crops(
        "yaw",
        torch.from_numpy(crops.images),
        torch.from_numpy(crops.targets),
        seeded(40),
    )
    flipped = (images != torch.from_numpy(crops.images)).flatten(1).any(1).numpy()
    assert 5 < flipped.sum() < 35
    mean = np.angle(targets.numpy() @ np.exp(1j * bin_centres()))
    expected = np.where(flipped, -yaw, yaw)
    assert np.abs((mean - expected + np.pi) % (2 * np.pi) - np.pi).max() < 1e-3
    u = np.arange(SIDE) - (SIDE - 1) / 2
    leftward = (
        -(images[..., 3].numpy() > 0).sum(1) @ u
    )  # the notch shifts the centroid of the mask to its side
    np.testing.assert_array_equal(np.sign(leftward), np.sign(np.sin(expected)))


def test_three_crops_of_ten_are_truncated_on_one_side():
    images = torch.full((300, SIDE, SIDE, 6), 9, dtype=torch.uint8)
    out = truncate_crops(images, seeded(300))
    lost = (out == 0).all(-1)
    truncated = lost.all(1).any(1) | lost.all(2).any(1)  # complete rows or columns
    assert 60 < truncated.sum() < 120 and torch.equal(truncated, lost.flatten(1).any(1))
    assert lost.flatten(1).float().mean(1).max() < 0.41


def test_perturbed_crops_keep_their_shape_and_are_finite():
    crops = notched_discs(16)[0]
    inputs = normalise_crops(torch.from_numpy(crops.images))
    out, context = perturb_crops(inputs, torch.from_numpy(crops.context), seeded(16))
    assert out.shape == inputs.shape and torch.isfinite(out).all() and torch.isfinite(context).all()
    assert not torch.equal(out, inputs)


def test_warped_crops_overlap_the_original_ones():
    inputs = normalise_crops(torch.from_numpy(notched_discs(16)[0].images))
    out = warp_crops(inputs, seeded(16))
    unwarped = warp_crops(inputs, seeded(16), most=0.0)
    assert torch.allclose(unwarped, inputs, atol=1e-3)
    before, after = inputs[:, 3] > 0.5, out[:, 3] > 0.5
    overlap = (before & after).flatten(1).sum(1) / (before | after).flatten(1).sum(1)
    assert overlap.min() > 0.55 and overlap.max() < 1.0
    assert out.flatten(1).abs().max() <= inputs.abs().max() + 1e-6


def test_varied_colours_stay_in_the_range_of_normalised_crops():
    colours = torch.rand(64, 3, 8, 8, generator=torch.Generator().manual_seed(1)) * 2 - 0.9
    out = vary_colours(colours, seeded(64))
    assert out.shape == colours.shape and not torch.allclose(out, colours)
    assert out.min() >= -0.9 and out.max() <= 1.1
    again = vary_colours(colours, seeded(64))
    assert torch.equal(again, out)


def test_a_share_of_the_rows_is_varied_as_in_the_whole_batch():
    crops = notched_discs(6)[0]
    images, context = torch.from_numpy(crops.images), torch.from_numpy(crops.context)

    def augmented(rows):
        draws = seeded(6, rows)
        mirrored, targets = mirror_crops("yaw", images[rows], torch.from_numpy(crops.targets)[rows], draws)
        inputs = warp_crops(normalise_crops(truncate_crops(mirrored, draws)), draws)
        return *perturb_crops(inputs, context[rows], draws), targets

    for whole, first, second in zip(*(augmented(r) for r in (slice(None), slice(0, 2), slice(2, 6)))):
        torch.testing.assert_close(torch.cat([first, second]), whole, rtol=0, atol=1e-6)
    assert [len(part) for part in augmented(slice(3, 3))] == [0, 0, 0]
