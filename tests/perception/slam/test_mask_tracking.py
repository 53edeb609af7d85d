"""Masks rendered from the true map of cylinders, compared with the true masks."""

from dataclasses import replace

import numpy as np
import pytest

from perception.geometry import se3_exp
from perception.slam.association import RenderedMasks, render_masks
from perception.slam.labelled_frame import with_pose
from perception.slam.mask_tracking import MaskTrackingConfig, _grown, track_masks


@pytest.fixture(scope="module")
def view(observe, T_view):
    return observe(T_view)


def tracked(cylinders, view, world=None, T=None, frame=None, config=MaskTrackingConfig()):
    frame = with_pose(frame or view.frame, view.T_world_camera if T is None else T)
    rendered = render_masks(world or cylinders.map(), frame, frame.T_world_camera)
    return track_masks(3, frame, rendered, cylinders.plane, config)


def test_masks_are_the_true_ones_above_the_contact(cylinders, view):
    masks = tracked(cylinders, view)
    assert masks.view.number == 3 and not masks.view.detections
    label_of = {id: label for label, id in masks.view.landmark_of.items()}
    for label, id in view.landmark_of.items():
        own, true = masks.view.labels == label_of[id], view.labels == label
        assert (own & true).sum() > 0.97 * own.sum() and own.sum() > 0.75 * true.sum()
        assert masks.explained[id] > 0.75
    assert masks.n_unexplained == 0


def test_outlines_are_those_of_the_measurement_not_of_the_prediction(cylinders, view):
    """A wrong prediction moves the rendered masks by several pixels, the masks hardly."""
    T = view.T_world_camera @ se3_exp(np.array([0, 0.02, 0, 0, 0, 0]))  # about 6 of 320 pixels
    right, wrong = tracked(cylinders, view).view, tracked(cylinders, view, T=T).view
    for label, id in right.landmark_of.items():
        other = next(k for k, x in wrong.landmark_of.items() if x == id)
        a, b = right.labels == label, wrong.labels == other
        assert (a & b).sum() > 0.85 * (a | b).sum()


def test_an_object_that_the_map_lacks_is_unexplained(cylinders, view):
    masks = tracked(cylinders, view, world=cylinders.map().without({3}))
    (label,) = (label for label, id in view.landmark_of.items() if id == 3)
    assert 3 not in masks.explained and 3 not in masks.view.landmark_of.values()
    assert 0.3 * (view.labels == label).sum() < masks.n_unexplained < (view.labels == label).sum()


def test_an_object_that_was_removed_is_not_explained(cylinders, view):
    gone = next(label for label, id in view.landmark_of.items() if id == 0)
    depth = np.where(view.labels == gone, view.frame.depth + 0.1, view.frame.depth)
    masks = tracked(cylinders, view, frame=replace(view.frame, depth=depth.astype(np.float32)))
    assert masks.explained[0] < 0.05 and min(masks.explained[id] for id in (1, 2, 3, 4)) > 0.75


def test_pixels_without_depth_belong_to_nothing(cylinders, view):
    dark = replace(view.frame, depth=np.zeros_like(view.frame.depth))
    masks = tracked(cylinders, view, frame=dark)
    assert not masks.view.labels.any() and masks.explained == {} == masks.view.landmark_of


def test_an_empty_map_explains_nothing(cylinders, view):
    none = RenderedMasks(np.full((60, 80), -1), np.zeros((60, 80)), np.zeros((60, 80)), {}, {}, 4)
    masks = track_masks(0, view.frame, none, cylinders.plane)
    assert masks.n_unexplained > 1000 and not masks.view.landmark_of


def test_grown_masks_keep_a_border_where_they_meet():
    labels = np.zeros((5, 9), np.uint8)
    labels[2, 1], labels[2, 6] = 1, 2
    grown = _grown(labels, 3)
    assert grown[2].tolist() == [1, 1, 1, 255, 255, 2, 2, 2, 2]
    assert _grown(labels, 0).tolist() == labels.tolist()
