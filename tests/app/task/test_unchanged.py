"""Candidates in images from straight above, before and after a block beside one of them was taken away."""

from dataclasses import replace

import numpy as np
import pytest

from app.task.unchanged import ScannedRound, parts_as_before, with_judged, without_instances
from perception.detection.left_out import of_no_class
from perception.pipeline import Detections
from perception.types import RejectedObject, RgbdFrame, SupportPlane, unclassified
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


def seen(*images, detections=None):
    """A round before; without detections no candidate was segmented then."""
    return ScannedRound(images, detections or Detections(SupportPlane(), ((),)))


def judged(detections):
    return [candidate.was_judged for candidate in detections.left_out]


def test_what_looks_as_before_was_judged(things):
    detections = candidates(*things)
    before, now = image(*things, seed=1), image(*things, seed=2)
    marked = with_judged(detections, [now], seen(before))
    assert judged(marked) == [True, True]
    assert marked == replace(detections, left_out=marked.left_out)


def test_what_something_was_taken_away_from_is_judged_again(things):
    removed = block(PLACE[0] - 0.02, PLACE[1], half=0.02)
    marked = with_judged(candidates(*things), [image(*things)], seen(image(*things, removed, seed=1)))
    assert judged(marked) == [False, True]


@pytest.mark.parametrize("change", ["none", "other mask", "other reason", "hidden", "left"])
def test_what_was_segmented_as_it_is_now_was_judged_whatever_was_taken_away_beside_it(things, change, can_at):
    removed = block(PLACE[0] - 0.02, PLACE[1], half=0.02)
    then = candidates(*things)
    if change == "other mask":
        then = candidates(block(*NEAR, half=0.03), things[1])
    if change == "other reason":
        then = replace(then, left_out=tuple(replace(c, reason="too high") for c in then.left_out))
    hidden = [block(NEAR[0] + 0.01, NEAR[1], half=0.02, height=0.09)] if change == "hidden" else []
    left = can_at(3, NEAR[0])
    at_near = left.T_world_object.copy()
    at_near[:2, 3] = NEAR
    marked = with_judged(
        candidates(*things),
        [image(*things)],
        seen(image(*things, removed, *hidden, seed=1), detections=then),
        [replace(left, T_world_object=at_near)] if change == "left" else [],
    )
    assert judged(marked) == [change == "none", True]


def test_what_appeared_or_moved_is_judged(things):
    marked = with_judged(candidates(*things), [image(*things)], seen(image(things[1], seed=1)))
    assert judged(marked) == [False, True]


def test_an_object_that_was_left_is_fitted_again(things, can_at):
    left = can_at(3, FAR[0])
    at_far = left.T_world_object.copy()
    at_far[:2, 3] = FAR
    marked = with_judged(
        candidates(*things),
        [image(*things)],
        seen(image(*things, seed=1)),
        [replace(left, T_world_object=at_far)],
    )
    assert judged(marked) == [True, False]


def test_without_an_image_from_the_same_viewpoint_nothing_is_known(things):
    other = image(*things, shift=0.02)
    assert judged(with_judged(candidates(*things), [image(*things)], seen(other))) == [False, False]
    assert judged(with_judged(candidates(*things), [image(*things)], seen())) == [False, False]
    assert with_judged(Detections(SupportPlane(), ()), [], seen()).left_out == ()
    frames, before = [image(*things), other], seen(image(*things, seed=1))
    assert judged(with_judged(candidates(*things), frames, before)) == [False, False]
    marked = with_judged(candidates(*things), frames, before, n_scanned=1)
    assert judged(marked) == [True, True], "the second image is not of the scan"


def detected(*things):
    """Detections of things with ids from 5 on."""
    masks = [overhead(*PLACE, obstacle=thing).depth < 0.47 for thing in things]
    return Detections(SupportPlane(), (tuple(unclassified(mask, 5 + k) for k, mask in enumerate(masks)),))


def rejected_before(things, *others, is_part=True):
    """The round before, which saw the second of the things as a part, as its detection 5, and others."""
    item = RejectedObject(5, "mug", "it goes on", 0.9, is_part=is_part)
    return ScannedRound([image(*things, *others, seed=1)], detected(things[1]), (item,))


def test_a_part_of_a_thing_remains_one(things):
    before = rejected_before(things)
    (part,) = parts_as_before(detected(*things), [image(*things)], before)
    assert part == replace(before.rejected[0], id=6)


def test_a_part_remains_one_where_what_stood_beside_it_was_taken_away(things):
    removed = block(FAR[0] - 0.055, FAR[1], half=0.02)  # in the image it hides some of the thing
    before = rejected_before(things, removed)
    assert [part.id for part in parts_as_before(detected(*things), [image(*things)], before)] == [6]


@pytest.mark.parametrize("was_known", [True, False])
def test_a_part_remains_one_where_a_known_object_beside_it_was_taken_away(things, can_at, was_known):
    """What was none could be what the part went on in."""
    known = can_at(3, FAR[0] - 0.06, FAR[1])
    before = rejected_before(things, block(FAR[0] - 0.06, FAR[1], half=0.035))
    before = replace(before, objects=[known] if was_known else [])
    parts = parts_as_before(detected(*things), [image(*things)], before)
    assert [part.id for part in parts] == ([6] if was_known else [])


@pytest.mark.parametrize("change", ["moved", "touched", "another reason", "other viewpoint"])
def test_what_may_be_no_part_is_judged_again(things, change):
    now = list(things)
    before = rejected_before(things, is_part=change != "another reason")
    if change == "moved":
        now[1] = block(FAR[0] - 0.02, FAR[1], half=0.02)
    if change == "touched":
        before = rejected_before(things, block(FAR[0] - 0.04, FAR[1], half=0.02))
    shift = 0.02 if change == "other viewpoint" else 0.0
    assert parts_as_before(detected(*now), [image(*now, shift=shift)], before) == []


def test_instances_without_an_id_only_occlude(things):
    detections = detected(*things)
    ((first, second),) = without_instances(detections, [6]).per_frame
    assert (first.instance_id, second.instance_id) == (5, None)
    np.testing.assert_array_equal(second.mask, detections.per_frame[0][1].mask)
    assert without_instances(detections, []) is detections
