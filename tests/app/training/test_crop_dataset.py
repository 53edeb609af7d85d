"""Labelled crops: classes of masks, yaw of handles, perturbed masks, files."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from app.training.crop_dataset import (
    LabelledCrops,
    bodies_of_mugs,
    handle_share,
    label_crops,
    perturb_masks,
    perturb_plane,
)
from perception.errors import PerceptionError
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane
from sim_assets.cell.layout import PlanarPose
from sim_assets.datasets.labels import InstanceLabel

K = CameraIntrinsics(320, 240, 290.0, 290.0, 159.5, 119.5)
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])  # a camera with a vertical optical axis, image x along world x
DOWN[2, 3] = 0.5


def picture(things, patches):
    """Return a labelled top view; each patch is (u, v, radius, index of its object or -1), 6 cm high."""
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
        surroundings=None,
        labels=tuple(
            InstanceLabel(category, PlanarPose(0, 0, yaw).matrix, 0, 0.0, 0.1, np.zeros(3), False, *resting)
            for category, yaw, *resting in things
        ),
    )


def true_masks(image):
    return [image.instances == k for k in range(len(image.labels)) if (image.instances == k).any()]


def test_masks_have_the_class_of_their_object():
    image = picture(
        [("can", 0.0), (None, 0.0), ("bowl", 0.0)], [(60, 60, 25, 0), (160, 60, 25, 1), (250, 150, 40, 2)]
    )
    crops = label_crops(image, SupportPlane(), true_masks(image))
    assert sorted(crops.label.tolist()) == [1, 3, 4]
    assert crops.images.dtype == np.uint8 and crops.images.shape == (3, 64, 64, 6)


def test_a_mask_of_unlabelled_geometry_has_the_class_other():
    image = picture([("can", 0.0)], [(100, 100, 30, -1)])
    crops = label_crops(image, SupportPlane(), [image.frame.depth < 0.45])
    assert crops.label.tolist() == [4]


def test_a_mask_of_two_objects_is_ambiguous_and_skipped():
    image = picture([("can", 0.0), ("bowl", 0.0)], [(100, 100, 25, 0), (140, 100, 25, 1)])
    assert len(label_crops(image, SupportPlane(), [image.instances >= 0])) == 0


def test_yaw_is_relative_to_the_upward_direction_of_the_crop():
    """Seen from straight above, up in the crop is the image's top: world +y."""
    image = picture([("mug", 0.3)], [(160, 120, 30, 0)])
    crops = label_crops(image, SupportPlane(), true_masks(image))
    assert crops.yaw == pytest.approx([0.3 - np.pi / 2], abs=0.02)


def test_the_direction_of_what_lies_is_that_of_its_axis():
    """The axis of a lying item is a right angle behind the yaw of its mesh."""
    for resting, expected in (("lying", 0.3 - np.pi), ("upright", 0.0)):
        image = picture([("can", 0.3, resting)], [(160, 120, 30, 0)])
        crops = label_crops(image, SupportPlane(), true_masks(image))
        assert crops.yaw == pytest.approx([expected], abs=0.02)


def test_perturbed_masks_overlap_the_true_ones_and_those_of_distractors_less():
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


def test_furniture_gives_masks_of_no_object():
    image = picture([("can", 0.0)], [(100, 120, 40, 0)])
    image.surroundings = np.zeros(image.instances.shape, bool)
    image.surroundings[:, 240:] = True
    rng = np.random.default_rng(0)
    masks = [mask for _ in range(60) for mask in perturb_masks(image, rng)]
    around = [mask for mask in masks if mask[:, 240:].sum() > 0.9 * mask.sum()]
    assert 0.2 * 60 < len(around) < 0.5 * 60
    assert not any((mask & (image.instances >= 0)).any() for mask in around)
    assert set(label_crops(image, SupportPlane(), around).label) == {4}


def test_masks_astray_include_a_part_of_a_neighbour_or_lose_a_part():
    image = picture([("can", 0.0), (None, 0.0)], [(100, 120, 30, 0), (165, 120, 25, 1)])
    rng = np.random.default_rng(0)
    found = [perturb_masks(image, rng, astray=share)[0] for share in [0.0] * 20 + [1.0] * 20]
    on_neighbour = np.array([(mask & (image.instances == 1)).sum() for mask in found])
    assert on_neighbour[:20].max() == 0 and np.median(on_neighbour[20:]) > 20
    alone = picture([("can", 0.0)], [(100, 120, 30, 0)])
    complete, reduced = (
        [perturb_masks(alone, rng, astray=a)[0].sum() for _ in range(20)] for a in (0.0, 1.0)
    )
    assert np.median(reduced) < 0.97 * np.median(complete) and min(reduced) > 0.3 * np.median(complete)


def test_handle_points_lie_outside_the_body_along_x():
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


def test_crops_are_loaded_as_saved_and_concatenated(tmp_path):
    crops = synthetic()
    (tmp_path / "a.npz").write_bytes(crops.packed())
    loaded = LabelledCrops.load(tmp_path / "a.npz")
    assert np.array_equal(loaded.images, crops.images)
    assert len(LabelledCrops.concatenate([crops, loaded])) == 6


def test_the_error_of_a_damaged_file_has_its_name(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(PerceptionError, match=r"a\.npz holds no labelled crops"):
        LabelledCrops.load(tmp_path / "a.npz")


def test_objects_whose_class_is_not_to_be_learned_give_no_crop():
    image = picture([("can", 0.0), ("bowl", 0.0)], [(60, 60, 25, 0), (160, 60, 25, 1)])
    image.labels = (replace(image.labels[0], ignored=True), image.labels[1])
    assert label_crops(image, SupportPlane(), true_masks(image)).label.tolist() == [1]


def test_the_perturbed_plane_stays_near_its_own():
    rng, plane = np.random.default_rng(0), SupportPlane(np.array([0.0, 0.6, 0.8]), 0.3)
    drawn = [perturb_plane(plane, rng) for _ in range(200)]
    tilt = [np.degrees(np.arccos(np.clip(p.normal @ plane.normal, -1, 1))) for p in drawn]
    assert 0.2 < np.mean(tilt) < 0.5 and np.std([p.offset for p in drawn]) == pytest.approx(0.0015, rel=0.2)
    assert all(np.linalg.norm(p.normal) == pytest.approx(1) for p in drawn)


@pytest.mark.parametrize(
    ("category", "handle", "has_body"),
    [("mug", 24, True), ("mug", 0, False), ("bowl", 24, False), (None, 24, False)],
)
def test_bodies_are_masks_of_mugs_without_their_handles(category, handle, has_body):
    image = picture([(category, 0.0)], [(100, 120, 30, 0)])
    v, u = np.mgrid[: K.height, : K.width]
    bar = (np.abs(v - 120) < 5) & (u > 100) & (u < 130 + handle)
    image.instances[bar] = 0
    mask = image.instances == 0
    bodies = bodies_of_mugs(image, [mask, np.zeros_like(mask)])
    assert len(bodies) == has_body
    if has_body:
        disc = np.hypot(u - 100, v - 120) < 30
        assert (bodies[0] & disc).sum() > 0.97 * disc.sum()
        assert not (bodies[0] & (u > 133)).any()


def test_what_is_ignored_has_no_body():
    """A mug that does not stand."""
    image = picture([("mug", 0.0)], [(100, 120, 30, 0)])
    v, u = np.mgrid[: K.height, : K.width]
    image.instances[(np.abs(v - 120) < 5) & (u > 100) & (u < 154)] = 0
    image.labels = (replace(image.labels[0], ignored=True),)
    assert bodies_of_mugs(image, [image.instances == 0]) == []
