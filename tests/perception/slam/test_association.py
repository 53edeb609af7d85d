"""Association by previous masks, by rendered masks and by position; see-through ratios."""

from dataclasses import replace

import numpy as np
import pytest

from perception.slam.association import (
    MaskAssociationConfig,
    RenderedMasks,
    associate_masks,
    render_masks,
    see_through_ratios,
)


@pytest.fixture(scope="module")
def view(observe, T_view):
    return observe(T_view)


@pytest.fixture(scope="module")
def unmatched(view):
    return replace(view, landmark_of={})


def rendering(cylinders, view):
    return lambda: render_masks(cylinders.map(), view.frame, view.T_world_camera)


def test_rendered_masks_agree_with_the_true_ones(cylinders, view):
    rendered = render_masks(cylinders.map(), view.frame, view.T_world_camera, pitch=2)
    for label, id in view.landmark_of.items():
        mask, own = view.labels[::2, ::2] == label, rendered.landmark_ids == id
        assert (own & mask).sum() > 0.85 * (own | mask).sum()
        assert rendered.n_visible[id] == own.sum() <= rendered.n_unoccluded[id]
        inner = own & mask & (view.frame.depth[::2, ::2] > 0)
        assert np.median(np.abs(rendered.depth - view.frame.depth[::2, ::2])[inner]) < 0.003
    none = rendered.landmark_ids < 0
    assert (rendered.depth[none] == 0).all() and (rendered.depth[~none] > 0).all()


def test_an_occluded_landmark_has_fewer_visible_than_unoccluded_pixels(cylinders, scenes):
    T = scenes.orbit((0, 0, 0.03), 0.4, 12, np.degrees(np.arctan2(0.08, -0.14)))
    frame, _, _ = cylinders.look(T)
    rendered = render_masks(cylinders.map(), frame, T, pitch=2)
    assert rendered.n_visible[0] < 0.7 * rendered.n_unoccluded[0]
    assert rendered.n_visible[2] == rendered.n_unoccluded[2]


def test_an_empty_map_renders_nothing(cylinders, view):
    empty = cylinders.map().without(set(cylinders.map().ids))
    rendered = render_masks(empty, view.frame, view.T_world_camera)
    assert (rendered.landmark_ids == -1).all() and rendered.landmark_ids.shape == (60, 80)
    assert rendered.n_visible == {} == rendered.n_unoccluded


def test_masks_are_associated_by_rendering(cylinders, view, unmatched):
    found = associate_masks(unmatched, None, rendering(cylinders, view), cylinders.map())
    assert found == view.landmark_of


def test_previous_masks_come_first_and_spare_the_rendering(cylinders, view, unmatched):
    def never():
        raise AssertionError("rendered")

    assert associate_masks(unmatched, view, never, cylinders.map()) == view.landmark_of


def test_previous_masks_of_another_image_size_are_ignored(cylinders, view, unmatched):
    previous = replace(view, labels=view.labels[::2, ::2])
    found = associate_masks(unmatched, previous, rendering(cylinders, view), cylinders.map())
    assert found == view.landmark_of


def test_swapped_labels_are_rejected_by_position(cylinders, view, unmatched):
    swapped = {**view.landmark_of, 1: view.landmark_of[2], 2: view.landmark_of[1]}
    previous = replace(view, landmark_of=swapped)
    found = associate_masks(unmatched, previous, rendering(cylinders, view), cylinders.map())
    assert found == view.landmark_of


@pytest.mark.parametrize(("margin", "matches"), [(0.03, True), (-0.2, False)])
def test_the_position_margin_extends_the_bounding_sphere(cylinders, view, unmatched, margin, matches):
    config = MaskAssociationConfig(position_margin=margin)
    found = associate_masks(unmatched, view, rendering(cylinders, view), cylinders.map(), config)
    assert bool(found) == matches


def test_a_mask_below_the_least_iou_is_not_associated(cylinders, view, unmatched):
    """A mask that covers 30 % of the rendered one matches from an IoU of 0.2, not from 0.4."""
    rows, columns = np.nonzero(view.labels == 1)
    labels = np.array(view.labels)
    cut = rows > np.quantile(rows, 0.3)
    labels[rows[cut], columns[cut]] = 0
    part = replace(unmatched, labels=labels)
    render, strict = rendering(cylinders, view), MaskAssociationConfig(min_iou=0.45, part_ratio=1.0)
    assert associate_masks(part, None, render, cylinders.map())[1] == view.landmark_of[1]
    assert 1 not in associate_masks(part, None, render, cylinders.map(), strict)


def test_parts_of_one_mask_are_associated_with_the_same_landmark(cylinders, view, unmatched):
    rows, columns = np.nonzero(view.labels == 1)
    labels = np.array(view.labels)
    low = rows > np.quantile(rows, 0.6)
    labels[rows[low], columns[low]] = 200
    split, render = replace(unmatched, labels=labels), rendering(cylinders, view)
    found = associate_masks(split, None, render, cylinders.map())
    assert found[1] == found[200] == view.landmark_of[1]
    strict = MaskAssociationConfig(part_ratio=1.0)
    assert len({1, 200} & set(associate_masks(split, None, render, cylinders.map(), strict))) == 1


def test_the_see_through_ratio_of_a_removed_object_is_high_and_of_others_low(cylinders, view):
    T, ids = view.T_world_camera, set(view.landmark_of.values())
    rendered = render_masks(cylinders.map(), view.frame, T)
    complete = see_through_ratios(rendered, view.frame)
    assert set(complete) == ids and max(complete.values()) < 0.2
    without_first, _, _ = replace(cylinders, places=cylinders.places[1:]).look(T)
    ratios = see_through_ratios(rendered, without_first)
    assert ratios.pop(0) > 0.8 and max(ratios.values()) < 0.2


def test_see_through_ratio_by_hand(view):
    """Of ten pixels, two have no measurement and two an occluder's; three of the other six lie behind."""
    measured = np.array([0, 0, 0.4, 0.487, 0.5, 0.489, 0.511, 0.52, 0.513, 0.6])
    frame = replace(view.frame, depth=np.tile(np.repeat(measured, 32), (240, 1)).astype(np.float32))
    blank = np.zeros((240, 320))
    rendered = RenderedMasks(blank.astype(int), blank + 0.5, blank, {}, {}, 1)
    assert see_through_ratios(rendered, frame) == {0: pytest.approx(0.5)}
    uncertain = replace(rendered, sigma=blank + 0.01)  # 2 sigma: of the three only 0.6 m remains behind
    assert see_through_ratios(uncertain, frame) == {0: pytest.approx(1 / 6)}
    n_counted = 240 * 32 * 6
    assert see_through_ratios(rendered, frame, MaskAssociationConfig(min_pixels=n_counted)) != {}
    assert see_through_ratios(rendered, frame, MaskAssociationConfig(min_pixels=n_counted + 1)) == {}
