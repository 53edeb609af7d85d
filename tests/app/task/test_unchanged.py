"""Candidates in images from straight above, before and after a block beside one of them was taken away."""

from dataclasses import replace

import numpy as np
import pytest

from app.task.unchanged import with_judged
from perception.detection.left_out import of_no_class
from perception.pipeline import Detections
from perception.types import RgbdFrame, SupportPlane
from tests.app.task.test_obstacles import block, overhead

NEAR, FAR = (0.43, -0.2), (0.62, -0.2)  # two things; the block that is taken away is beside the first
PLACE = (0.5, -0.2)


def image(*blocks, seed=0, shift=0.0):
    """One view of blocks, with 2 mm of noise."""
    frames = [overhead(PLACE[0] + shift, PLACE[1], obstacle=b) for b in blocks]
    depth = np.min([frame.depth for frame in frames], axis=0)
    noise = 0.002 * np.random.default_rng(seed).standard_normal(depth.shape)
    frame = frames[0]
    return RgbdFrame(
        0.0, frame.rgb, (depth + noise).astype(np.float32), frame.intrinsics, frame.T_world_camera
    )


def candidates(*things):
    masks = [overhead(*PLACE, obstacle=thing).depth < 0.47 for thing in things]
    return Detections(SupportPlane(), ((),), left_out=tuple(of_no_class(mask, 0.9) for mask in masks))


@pytest.fixture
def things():
    return block(*NEAR, half=0.02), block(*FAR, half=0.02)


def judged(detections):
    return [candidate.was_judged for candidate in detections.left_out]


def test_what_looks_as_before_was_judged(things):
    detections = candidates(*things)
    before, now = image(*things, seed=1), image(*things, seed=2)
    marked = with_judged(detections, [now], [before])
    assert judged(marked) == [True, True]
    assert marked == replace(detections, left_out=marked.left_out)


def test_what_something_was_taken_away_from_is_judged_again(things):
    removed = block(PLACE[0] - 0.02, PLACE[1], half=0.02)
    marked = with_judged(candidates(*things), [image(*things)], [image(*things, removed, seed=1)])
    assert judged(marked) == [False, True]


def test_what_appeared_or_moved_is_judged(things):
    marked = with_judged(candidates(*things), [image(*things)], [image(things[1], seed=1)])
    assert judged(marked) == [False, True]


def test_an_object_that_was_left_is_fitted_again(things, can_at):
    left = can_at(3, FAR[0])
    at_far = left.T_world_object.copy()
    at_far[:2, 3] = FAR
    marked = with_judged(
        candidates(*things),
        [image(*things)],
        [image(*things, seed=1)],
        [replace(left, T_world_object=at_far)],
    )
    assert judged(marked) == [True, False]


def test_without_an_image_from_the_same_viewpoint_nothing_is_known(things):
    other = image(*things, shift=0.02)
    assert judged(with_judged(candidates(*things), [image(*things)], [other])) == [False, False]
    assert judged(with_judged(candidates(*things), [image(*things)], [])) == [False, False]
    assert with_judged(Detections(SupportPlane(), ()), [], []).left_out == ()
