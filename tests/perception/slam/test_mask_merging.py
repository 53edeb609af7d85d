"""Merging of the fragments of one vessel, and of nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from perception.slam.labelled_frame import label_image
from perception.slam.mask_merging import MaskMergingConfig, adjacent_masks, merge_masks
from perception.types import ObjectDetection, SupportPlane

PLANE = SupportPlane()


def mugs(scene, n):
    return [ObjectDetection("mug", 0.9, scene.instances == k) for k in range(n)]


@pytest.fixture(scope="module")
def arcs(scenes):
    """One cylinder from 60 degrees above; its mask is split across the line of sight, the top part larger."""
    scene = scenes.render([scenes.Solid(0, 0, 0.08, radius=0.05)], scenes.orbit((0, 0, 0.03), 0.5, 60, 0))
    mask = scene.instances == 0
    top, bottom = np.array(mask), np.array(mask)
    middle = int(np.nonzero(mask)[0].mean()) + 4
    top[middle:], bottom[:middle] = False, False
    return scene.frame, mask, ObjectDetection("bowl", 0.7, top), ObjectDetection("mug", 0.9, bottom)


def test_arcs_of_one_vessel_are_merged_and_the_larger_determines_the_class(arcs):
    frame, mask, top, bottom = arcs
    (merged,) = merge_masks(frame, [bottom, top], PLANE)
    assert (merged.mask == mask).all() and merged.category == "bowl" and merged.score == 0.7


def test_other_classes_are_not_merged(arcs):
    frame, _, top, bottom = arcs
    bottles = [replace(part, category="bottle") for part in (top, bottom)]
    assert len(merge_masks(frame, bottles, PLANE)) == 2
    assert len(merge_masks(frame, [top, bottles[1]], PLANE)) == 2


@pytest.mark.parametrize(
    "config",
    [
        MaskMergingConfig(max_size=0.09),
        MaskMergingConfig(max_elongation=0.8),
        MaskMergingConfig(max_top_difference=-1.0),
        MaskMergingConfig(min_contact=1000),
        MaskMergingConfig(min_overlap=1.1),
    ],
)
def test_each_condition_prevents_merging(arcs, config):
    frame, _, top, bottom = arcs
    assert len(merge_masks(frame, [top, bottom], PLANE, config)) == 2


def test_fragments_whose_tops_differ_in_height_are_not_merged(scenes):
    T = scenes.orbit((0, 0, 0.03), 0.5, 55, 0)
    solids = [scenes.Solid(0.02, 0, 0.03, half=(0.02, 0.04)), scenes.Solid(-0.02, 0, 0.06, half=(0.02, 0.04))]
    scene = scenes.render(solids, T)
    assert len(merge_masks(scene.frame, mugs(scene, 2), PLANE)) == 2
    assert (
        len(merge_masks(scene.frame, mugs(scene, 2), PLANE, MaskMergingConfig(max_top_difference=0.05))) == 1
    )


def test_a_vessel_behind_another_is_not_merged_with_it(scenes):
    T = scenes.orbit((0, 0, 0.03), 0.5, 35, 0)
    solids = [scenes.Solid(0.06, 0, 0.08, radius=0.04), scenes.Solid(-0.06, 0, 0.08, radius=0.04)]
    scene = scenes.render(solids, T)
    assert adjacent_masks(label_image(mugs(scene, 2), scene.instances.shape), 8) == [(0, 1)]
    assert len(merge_masks(scene.frame, mugs(scene, 2), PLANE)) == 2


def test_a_vessel_beside_another_is_not_merged_with_it(scenes):
    T = scenes.orbit((0, 0, 0.03), 0.5, 50, 0)
    solids = [scenes.Solid(0.03, -0.032, 0.08, radius=0.04), scenes.Solid(-0.03, 0.032, 0.08, radius=0.04)]
    scene = scenes.render(solids, T)
    assert adjacent_masks(label_image(mugs(scene, 2), scene.instances.shape), 8) == [(0, 1)]
    assert len(merge_masks(scene.frame, mugs(scene, 2), PLANE)) == 2
    assert len(merge_masks(scene.frame, mugs(scene, 2), PLANE, MaskMergingConfig(min_overlap=-1.0))) == 1


def test_a_small_fragment_need_not_overlap(arcs):
    frame, mask, top, _ = arcs
    beside = mask & (np.arange(mask.shape[1]) > np.quantile(np.nonzero(mask)[1], 0.8))
    parts = [replace(top, mask=mask & ~beside), ObjectDetection("mug", 0.6, beside)]
    (merged,) = merge_masks(frame, parts, PLANE)
    assert (merged.mask == mask).all()
    assert len(merge_masks(frame, parts, PLANE, MaskMergingConfig(small_ratio=0.1))) == 2


def test_fragments_without_points_above_the_plane_are_not_merged(arcs):
    frame, _, top, bottom = arcs
    above = SupportPlane(np.array([0.0, 0.0, 1.0]), 0.2)
    assert len(merge_masks(frame, [top, bottom], above)) == 2


@pytest.mark.parametrize(("gap", "adjacent"), [(0, True), (2, True), (3, False)])
def test_adjacent_masks_bridge_gaps_of_two_pixels(gap, adjacent):
    labels = np.zeros((9, 20), np.uint8)
    labels[:, :6], labels[:, 6 + gap : 12 + gap] = 2, 1
    for image in (labels, labels.T):
        assert adjacent_masks(image, 9) == ([(0, 1)] if adjacent else [])
        assert adjacent_masks(image, 9 * 3 + 1) == []
