"""Crops named after the truth: which masks get a name, where handles point, what survives the disk."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.training.crop_dataset import LabelledCrops, handle_share, label_crops, perturb_masks
from perception.errors import PerceptionError
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane

K = CameraIntrinsics(320, 240, 290.0, 290.0, 159.5, 119.5)
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])  # a camera that looks straight down, image x along world x
DOWN[2, 3] = 0.5


def picture(things, patches):
    """A top view; each patch is (u, v, radius, number of the thing it shows or -1), 6 cm high."""
    v, u = np.mgrid[: K.height, : K.width]
    depth = np.full((K.height, K.width), 0.5, np.float32)
    instances = np.full(depth.shape, -1)
    for x, y, radius, number in patches:
        disc = np.hypot(u - x, v - y) < radius
        depth[disc], instances[disc] = 0.44, number
    frame = RgbdFrame(0.0, np.full((*depth.shape, 3), 128, np.uint8), depth, K, DOWN)
    return SimpleNamespace(
        frame=frame,
        instances=instances,
        labels=tuple(
            SimpleNamespace(category=category, yaw=yaw, T_world_object=np.eye(4)) for category, yaw in things
        ),
    )


def true_masks(image):
    return [image.instances == k for k in range(len(image.labels)) if (image.instances == k).any()]


def test_masks_are_named_after_what_they_show():
    image = picture(
        [("can", 0.0), (None, 0.0), ("bowl", 0.0)], [(60, 60, 25, 0), (160, 60, 25, 1), (250, 150, 40, 2)]
    )
    crops = label_crops(image, SupportPlane(), true_masks(image))
    assert sorted(crops.label.tolist()) == [1, 3, 4]
    assert crops.images.dtype == np.uint8 and crops.images.shape == (3, 64, 64, 6)


def test_what_nobody_put_there_is_of_no_class():
    image = picture([("can", 0.0)], [(100, 100, 30, -1)])
    crops = label_crops(image, SupportPlane(), [image.frame.depth < 0.45])
    assert crops.label.tolist() == [4]


def test_a_merger_has_no_name():
    image = picture([("can", 0.0), ("bowl", 0.0)], [(100, 100, 25, 0), (140, 100, 25, 1)])
    assert len(label_crops(image, SupportPlane(), [image.instances >= 0])) == 0


def test_yaw_counts_from_the_crops_up():
    """Seen from straight above, up in the crop is the image's top: world +y."""
    image = picture([("mug", 0.3)], [(160, 120, 30, 0)])
    crops = label_crops(image, SupportPlane(), true_masks(image))
    assert crops.yaw == pytest.approx([0.3 - np.pi / 2], abs=0.02)


def test_disturbed_masks_stay_near_the_true_ones_and_cut_distractors_more_often():
    image = picture([("can", 0.0), (None, 0.0)], [(100, 120, 40, 0), (230, 120, 40, 1)])
    rng = np.random.default_rng(0)
    overlaps = {0: [], 1: []}
    for _ in range(40):
        for mask in perturb_masks(image, rng):
            for k, found in overlaps.items():
                true = image.instances == k
                if (mask & true).any():
                    found.append((mask & true).sum() / (mask | true).sum())
    assert np.median(overlaps[0]) > 0.93
    assert np.mean(np.array(overlaps[0]) < 0.9) < 0.2 < np.mean(np.array(overlaps[1]) < 0.9)


def test_some_masks_take_in_a_piece_of_a_neighbour_and_lose_one_of_their_own():
    image = picture([("can", 0.0), (None, 0.0)], [(100, 120, 30, 0), (165, 120, 25, 1)])
    rng = np.random.default_rng(0)
    found = [perturb_masks(image, rng, astray=share)[0] for share in [0.0] * 20 + [1.0] * 20]
    on_neighbour = np.array([(mask & (image.instances == 1)).sum() for mask in found])
    assert on_neighbour[:20].max() == 0 and np.median(on_neighbour[20:]) > 20
    alone = picture([("can", 0.0)], [(100, 120, 30, 0)])
    whole, bitten = ([perturb_masks(alone, rng, astray=a)[0].sum() for _ in range(20)] for a in (0.0, 1.0))
    assert np.median(bitten) < 0.97 * np.median(whole) and min(bitten) > 0.3 * np.median(whole)


def test_handle_points_are_those_outside_the_body_towards_x():
    angle = np.linspace(-np.pi, np.pi, 400, endpoint=False)
    body = np.stack([0.04 * np.cos(angle), 0.04 * np.sin(angle), np.full(400, 0.05)], 1)
    handle = np.stack([np.linspace(0.05, 0.07, 100), np.zeros(100), np.full(100, 0.05)], 1)
    T = np.eye(4)
    T[:3, 3] = (0.4, -0.2, 0.0)
    assert handle_share(body + T[:3, 3], T) == 0.0
    assert handle_share(np.concatenate([body, handle]) + T[:3, 3], T) == pytest.approx(0.2)
    assert handle_share(np.zeros((0, 3)), T) == 0.0


def synthetic(n=3):
    rng = np.random.default_rng(0)
    numbers = [rng.random(n).astype(np.float32) for _ in range(2)]
    images = rng.integers(0, 255, (n, 64, 64, 6), dtype=np.uint8)
    return LabelledCrops(images, rng.random((n, 2)).astype(np.float32), np.arange(n), *numbers)


def test_crops_survive_the_disk_and_add_up(tmp_path):
    crops = synthetic()
    crops.save(tmp_path / "a.npz")
    loaded = LabelledCrops.load(tmp_path / "a.npz")
    assert np.array_equal(loaded.images, crops.images)
    assert len(LabelledCrops.concatenate([crops, loaded])) == 6


def test_a_damaged_file_is_named(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(PerceptionError, match=r"a\.npz holds no labelled crops"):
        LabelledCrops.load(tmp_path / "a.npz")
