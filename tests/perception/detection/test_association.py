"""Association of detections across views: grouping on rendered scenes, fused votes in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import softmax

from perception.detection.association import (
    AssociationConfig,
    associate,
    associate_on_surfaces,
    fuse_views,
)
from perception.detection.yaw import modes, soft_labels
from perception.errors import InvalidInputError
from perception.support.surface import SupportSurface
from perception.types import CATEGORIES, CameraIntrinsics, ObjectDetection, RgbdFrame, SupportPlane

PLANE = SupportPlane()
CONFIG = AssociationConfig()
VIEWS = ((90, 0, 0.6), (55, 60, 0.5), (50, 180, 0.5), (50, 300, 0.5))


@pytest.fixture(scope="module")
def scan(scenes):
    """Four crossing views of a can, a tall bottle and a low wide one, 4 to 5 cm apart."""
    solids = [
        scenes.Solid(0.40, -0.28, 0.10, radius=0.035),
        scenes.Solid(0.52, -0.28, 0.18, radius=0.03),
        scenes.Solid(0.45, -0.15, 0.06, radius=0.06),
    ]
    return [
        scenes.render(solids, scenes.orbit((0.46, -0.22, 0.05), d, e, a), 0.002, size=(640, 480))
        for e, a, d in VIEWS
    ]


def probabilities(category, p):
    rest = np.full(5, (1 - p) / 4)
    rest[(*CATEGORIES, "other").index(category)] = p
    return rest


def detection(mask, category="can", p=0.8, yaw=None):
    probs = probabilities(category, p)
    best = int(probs[:4].argmax())
    return ObjectDetection(
        CATEGORIES[best], float(probs[best]), mask, probs, np.zeros(0) if yaw is None else yaw
    )


def true_detections(scan, category="can", p=0.8):
    return [[detection(s.instances == i, category, p) for i in range(3)] for s in scan]


def frames_of(scan):
    return [s.frame for s in scan]


def ids_by_solid(result, scan):
    """Return, for each view, the instance id of each solid."""
    rows = []
    for scene, detections in zip(scan, result):
        row = {}
        for d in detections:
            solids = scene.instances[d.mask & (scene.instances >= 0)]
            row[int(np.bincount(solids).argmax())] = d.instance_id
        rows.append(row)
    return rows


def test_detections_of_one_object_share_an_id_across_crossing_views(scan):
    detections = true_detections(scan)
    shuffled = [row[k:] + row[:k] for k, row in enumerate(detections)]
    rows = ids_by_solid(associate(frames_of(scan), shuffled, PLANE), scan)
    assert all(row == rows[0] for row in rows)
    assert sorted(rows[0].values()) == [0, 1, 2]


def test_confident_views_outvote_uncertain_ones(scan):
    detections = true_detections(scan)
    for view, (category, p) in enumerate((("can", 0.9), ("bottle", 0.6), ("can", 0.7), ("bottle", 0.5))):
        detections[view][0] = detection(scan[view].instances == 0, category, p)
    result = associate(frames_of(scan), detections, PLANE)
    fused = [d for row in result for d in row if d.instance_id == ids_by_solid(result, scan)[0][0]]
    assert {d.category for d in fused} == {"can"}
    assert len({d.score for d in fused}) == 1
    assert fused[0].class_probabilities.sum() == pytest.approx(1.0)
    unanimous = associate(frames_of(scan), true_detections(scan, p=0.9), PLANE)
    assert fused[0].score < unanimous[0][0].score


def test_objects_that_are_most_probably_distractors_are_dropped(scan):
    detections = true_detections(scan)
    for view, (category, p) in enumerate((("other", 0.7), ("can", 0.5), ("other", 0.7), ("other", 0.6))):
        detections[view][1] = detection(scan[view].instances == 1, category, p)
    result = associate(frames_of(scan), detections, PLANE)
    assert [len(row) for row in result] == [2, 2, 2, 2]
    assert all(set(row) == {0, 2} for row in ids_by_solid(result, scan))


@pytest.mark.parametrize(("p", "kept"), [(0.79, False), (0.81, True)])
def test_an_object_of_a_single_view_needs_a_high_score_if_two_views_missed_it(scan, p, kept):
    detections = true_detections(scan)
    for view in (1, 2):
        detections[view].pop(1)
    detections[0][1] = detection(scan[0].instances == 1, "can", p)
    lenient = replace(CONFIG, miss_probability=0.5)  # the fused vote itself accepts it
    rows = associate(frames_of(scan)[:3], detections[:3], PLANE, lenient)
    assert len(rows[0]) == (3 if kept else 2)
    rows = associate(frames_of(scan)[:2], detections[:2], PLANE, lenient)  # one missed view is no evidence
    assert len(rows[0]) == 3


def test_a_view_that_merges_objects_separated_by_the_others_is_left_out(scan):
    detections = true_detections(scan)
    both = (scan[1].instances == 0) | (scan[1].instances == 1)
    detections[1] = [detection(both), detections[1][2]]
    rows = ids_by_solid(associate(frames_of(scan), detections, PLANE), scan)
    assert [len(row) for row in rows] == [3, 1, 3, 3]
    assert rows[0] == rows[2] == rows[3]


def test_parts_of_an_object_that_other_views_show_whole_are_united(scan):
    detections = true_detections(scan)
    whole = scan[2].instances == 2
    left = whole & (np.arange(640) < np.nonzero(whole)[1].mean())
    detections[2] = [*detections[2][:2], detection(left), detection(whole & ~left)]
    result = associate(frames_of(scan), detections, PLANE)
    assert [len(row) for row in result] == [3, 3, 3, 3]
    assert any(np.array_equal(d.mask, whole) for d in result[2])


def test_yaw_of_mugs_is_the_product_over_the_views(scan):
    label = soft_labels(np.array([1.2]), spread=0.5)[0]
    ambiguous = 0.5 * label + 0.5 * soft_labels(np.array([4.0]), spread=0.5)[0]
    detections = [
        [detection(s.instances == 0, "mug", 0.9, yaw)]
        for s, yaw in zip(scan, (ambiguous, label, ambiguous, label))
    ]
    result = associate(frames_of(scan), detections, PLANE)
    fused = result[0][0].yaw_probabilities
    assert all(np.array_equal(row[0].yaw_probabilities, fused) for row in result)
    (yaw, _), *_ = modes(fused)
    assert yaw == pytest.approx(1.2, abs=0.05)


def test_symmetric_classes_have_no_yaw(scan):
    yaw = soft_labels(np.array([1.2]))[0]
    detections = [[detection(s.instances == 0, "can", 0.9, yaw)] for s in scan]
    assert len(associate(frames_of(scan), detections, PLANE)[0][0].yaw_probabilities) == 0


def test_instance_ids_go_by_number_of_views_then_score(scan):
    detections = true_detections(scan, p=0.9)
    for view in (2, 3):
        detections[view].pop(0)
    for view in range(4):
        detections[view][-1] = detection(scan[view].instances == 2, "bowl", 0.99)
    (first, *_) = ids_by_solid(associate(frames_of(scan), detections, PLANE), scan)
    assert first == {2: 0, 1: 1, 0: 2}


def test_a_single_frame_and_empty_lists_are_accepted(scan):
    (alone,) = associate(frames_of(scan)[:1], true_detections(scan)[:1], PLANE)
    assert sorted(d.instance_id for d in alone) == [0, 1, 2]
    assert associate(frames_of(scan), [[], [], [], []], PLANE) == [[], [], [], []]


def test_rejected_objects_are_returned_with_the_reason():
    left, right = square(20), square(100)
    other = np.array([0.015, 0.015, 0.015, 0.015, 0.94])
    rows, left_out = fuse_views([from_above(left, right)], [[with_probabilities(left, other)]], PLANE)
    assert rows == [[]]
    assert [c.text for c in left_out] == ["of none of the classes (p = 0.94)"] and left_out[0].frame == 0
    wide = square(0, size=H - 1) | square(W - H, size=H - 1)
    lenient = AssociationConfig(max_extent=0.02)
    _, left_out = fuse_views([from_above(wide)], [[with_probabilities(wide, A)]], PLANE, lenient)
    assert left_out[0].reason == "too wide for one object"


def test_a_weak_detection_of_one_view_is_left_out_in_that_view(scan):
    detections = [[], [detection(scan[1].instances == 0, "can", 0.5)], [], []]
    rows, left_out = fuse_views(frames_of(scan), detections, PLANE)
    assert not any(rows) and [(c.frame, c.reason) for c in left_out] == [(1, "seen in one view only")]


def test_ids_are_unique_over_the_surfaces(scan):
    (row,) = true_detections(scan)[:1]
    row = [replace(d, support=k % 2) for k, d in enumerate(row)]
    surfaces = (SupportSurface(PLANE), SupportSurface(SupportPlane(offset=-0.02)))
    ((found,), left_out) = associate_on_surfaces(frames_of(scan)[:1], [row], surfaces)
    assert not left_out and sorted((d.support, d.instance_id) for d in found) == [(0, 0), (0, 1), (1, 2)]


def test_inputs_are_checked(scan):
    with pytest.raises(InvalidInputError, match="4 frames but detections for 1"):
        associate(frames_of(scan), [[]], PLANE)
    f = scan[0].frame
    unposed = RgbdFrame(0.0, f.rgb, f.depth, f.intrinsics)
    with pytest.raises(InvalidInputError, match="needs T_world_camera"):
        associate([unposed, unposed], [[], []], PLANE)


# --- closed form: views from straight above, 1 mm per pixel at the height of the objects -------------------

H, W = 120, 160
TOP = 0.95  # [m] depth of the objects' tops, 5 cm above the table
K = CameraIntrinsics(W, H, 1000 * TOP, 1000 * TOP, (W - 1) / 2, (H - 1) / 2)


def from_above(*masks, x=0.0):
    """Return a view of flat blocks from 1 m above (x, 0): image right is world x, image down is world -y."""
    depth = np.full((H, W), 1.0, np.float32)
    for mask in masks:
        depth[mask] = TOP
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = (x, 0.0, 1.0)
    return RgbdFrame(0.0, np.zeros((H, W, 3), np.uint8), depth, K, T)


def square(left, top=40, size=40):
    mask = np.zeros((H, W), bool)
    mask[top : top + size, max(left, 0) : left + size] = True
    return mask


def expected(logs, n_views):
    return softmax(np.sum(logs, axis=0) * n_views**-0.5)


A, B = np.array([0.6, 0.1, 0.1, 0.1, 0.1]), np.array([0.05, 0.05, 0.7, 0.15, 0.05])


def with_probabilities(mask, p, yaw=None):
    best = int(p[:4].argmax())
    return ObjectDetection(CATEGORIES[best], float(p[best]), mask, p, np.zeros(0) if yaw is None else yaw)


def test_log_probabilities_add_up_as_the_square_root_of_the_number_of_views():
    mask = square(60)
    found = associate([from_above(mask)] * 2, [[with_probabilities(mask, p)] for p in (A, B)], PLANE)
    assert found[0][0].class_probabilities == pytest.approx(expected([np.log(A), np.log(B)], 2))
    assert found[0][0].score == pytest.approx(found[0][0].class_probabilities[:4].max())


def test_no_view_can_rule_out_a_class_alone():
    mask = square(60)
    certain = np.array([1.0, 0, 0, 0, 0])
    (found,) = associate([from_above(mask)], [[with_probabilities(mask, certain)]], PLANE)
    assert found[0].class_probabilities == pytest.approx(np.array([1, 0.005, 0.005, 0.005, 0.005]) / 1.02)


@pytest.mark.parametrize("border", ["left", "right", "top", "bottom"])
def test_a_truncated_mask_has_half_the_weight_of_a_whole_one(border):
    whole = square(60)
    if border in ("left", "right"):
        truncated = square(-8 if border == "left" else W - 32)
        shift = 0.001 * (60 - (-8 if border == "left" else W - 32))
        second = from_above(truncated, x=shift)
    else:
        truncated = np.zeros((H, W), bool)
        rows = slice(0, 32) if border == "top" else slice(H - 32, H)
        truncated[rows, 60:100] = True
        second = from_above(truncated)
        offset = (40 - (-8 if border == "top" else H - 32)) * 0.001
        T = second.T_world_camera.copy()
        T[1, 3] = -offset
        second = replace(second, T_world_camera=T)
    frames = [from_above(whole), second]
    for probabilities_, category in (((A, B), "mug"), ((B, A), "bottle")):
        rows = [[with_probabilities(m, p)] for m, p in zip((whole, truncated), probabilities_)]
        found = associate(frames, rows, PLANE)
        first, other = (np.log(p) for p in probabilities_)
        assert found[0][0].class_probabilities == pytest.approx(expected([first, 0.5 * other], 2))
        assert found[0][0].category == found[1][0].category == category


@pytest.mark.parametrize(("n_missed", "kept"), [(1, True), (2, True), (3, False)])
def test_every_view_that_missed_the_object_votes_against_it(n_missed, kept):
    """Two detections favour the mug by 6 x 6, each missed view favours 'other' by 4."""
    mask = square(60)
    rows = [[with_probabilities(mask, A)], [with_probabilities(mask, A)], *[[]] * n_missed]
    found = associate([from_above(mask)] * len(rows), rows, PLANE)
    assert [len(row) for row in found] == [int(kept), int(kept), *[0] * n_missed]
    if kept:
        logs = [np.log(A), np.log(A), *[np.log([0.2, 0.2, 0.2, 0.2, 0.8])] * n_missed]
        assert found[0][0].class_probabilities == pytest.approx(expected(logs, len(rows)))


@pytest.mark.parametrize(("other", "kept"), [(0.55, True), (0.89, True), (0.91, False)])
def test_a_single_view_leaves_uncertain_classes_to_the_fit(other, kept):
    p = np.array([0.95 - other, 0.02, 0.02, 0.01, other])
    (row,) = associate([from_above(square(60))], [[with_probabilities(square(60), p)]], PLANE)
    assert [(d.category, round(d.score, 6)) for d in row] == (
        [("mug", round(0.95 - other, 6))] if kept else []
    )
    twice = [[with_probabilities(square(60), p)]] * 2
    assert not any(associate([from_above(square(60))] * 2, twice, PLANE)), "two views agree on 'other'"


def votes(second):
    """Return the fused mug probability of an object detected in one view, given a second view without it."""
    mask = square(60)
    found = associate([from_above(mask), second], [[with_probabilities(mask, A)], []], PLANE)
    return float(found[0][0].class_probabilities[0])


ALONE = A[0]  # one view: no change
MISSED = expected([np.log(A), np.log([0.2, 0.2, 0.2, 0.2, 0.8])], 2)[0]


def test_a_view_votes_against_an_object_only_where_it_should_show_it():
    mask = square(60)
    seen = from_above(mask)
    assert votes(seen) == pytest.approx(MISSED)
    holes = replace(seen, depth=np.where(mask, 0, seen.depth).astype(np.float32))
    assert votes(holes) == pytest.approx(MISSED)  # no measurement is no occlusion
    occluded = replace(seen, depth=np.where(mask, 0.9, seen.depth).astype(np.float32))
    assert votes(occluded) == pytest.approx(ALONE)
    noisy = replace(seen, depth=np.where(mask, TOP - 0.02, seen.depth).astype(np.float32))
    assert votes(noisy) == pytest.approx(MISSED)  # within the tolerance of 3 cm
    for x in (-0.2, 0.2):
        assert votes(from_above(x=x)) == pytest.approx(ALONE)  # outside the image
    behind = seen.T_world_camera.copy()
    behind[:3, :3] = np.eye(3)  # looks up
    assert votes(replace(seen, T_world_camera=behind)) == pytest.approx(ALONE)


@pytest.mark.parametrize(("hidden", "expected_vote"), [(14, MISSED), (18, ALONE)])
def test_sixty_percent_of_the_points_must_be_visible(hidden, expected_vote):
    mask = square(60)
    depth = from_above(mask).depth.copy()
    depth[:, 62 : 62 + hidden] = 0.8  # of the 36 columns that remain after erosion
    assert votes(replace(from_above(mask), depth=depth)) == pytest.approx(expected_vote)


def test_a_detection_without_class_probabilities_votes_with_its_score():
    mask = square(60)
    (found,) = associate([from_above(mask)], [[ObjectDetection("bowl", 0.9, mask)]], PLANE)
    assert found[0].class_probabilities == pytest.approx([0.025, 0.9, 0.025, 0.025, 0.025])


@pytest.mark.parametrize(("shift", "n_objects"), [(21, 1), (30, 2)])
def test_footprints_of_one_object_overlap_by_three_tenths(shift, n_objects):
    left, right = square(50), square(50 + shift)
    rows = [[with_probabilities(left, A)], [with_probabilities(right, A)]]
    found = associate([from_above(left), from_above(right)], rows, PLANE)
    assert len({d.instance_id for row in found for d in row}) == n_objects


def test_detections_of_one_view_are_never_linked():
    one, other = square(50), square(60)
    row = [with_probabilities(one, A), with_probabilities(other & ~one, A)]
    (found,) = associate([from_above(one | other)], [row], PLANE)
    assert sorted(d.instance_id for d in found) == [0, 1]


@pytest.mark.parametrize(("length", "kept"), [(0.35, 1), (0.40, 0)])
def test_objects_longer_than_36_cm_are_dropped(scenes, length, kept):
    wall = scenes.Solid(0.5, 0.0, 0.08, half=(length / 2, 0.01))
    seen = scenes.render([wall], scenes.orbit((0.5, 0.0, 0.0), 0.8, 80, 90))
    (found,) = associate([seen.frame], [[detection(seen.instances == 0)]], PLANE)
    assert len(found) == kept


def boxes(*columns):
    """Return one mask for each range of columns, 40 rows high."""
    masks = np.zeros((len(columns), H, W), bool)
    for mask, (start, stop) in zip(masks, columns):
        mask[40:80, start:stop] = True
    return list(masks)


def associate_boxes(*views, p=A):
    """Associate views given as lists of masks; the blocks of all views are in every view."""
    frames = [from_above(*(m for view in views for m in view))] * len(views)
    return associate(frames, [[with_probabilities(m, p) for m in view] for view in views], PLANE)


def test_in_a_tie_the_larger_number_of_objects_wins():
    merged, parts = boxes((30, 110)), boxes((30, 68), (72, 110))
    assert [len(row) for row in associate_boxes(merged, parts)] == [0, 2]


def test_the_largest_footprints_are_the_anchors():
    whole, small = boxes((20, 55), (90, 125)), boxes((20, 32), (113, 125))
    merged, part = boxes((20, 125)), boxes((38, 54))
    found = associate_boxes(small, whole, part, merged)
    assert [len(row) for row in found] == [2, 2, 1, 0]
    assert found[2][0].instance_id == found[1][0].instance_id


def test_a_detection_without_overlap_with_an_anchor_is_left_out():
    whole, merged, between = boxes((20, 55), (90, 125)), boxes((20, 125)), boxes((62, 83))
    assert [len(row) for row in associate_boxes(whole, whole, merged, between)] == [2, 2, 0, 0]


def test_united_parts_have_the_class_of_the_largest():
    whole, parts = boxes((30, 110)), boxes((30, 50), (54, 110))
    frames = [from_above(*whole)] * 3
    rows = [[with_probabilities(whole[0], A)]] * 2
    rows.append([with_probabilities(parts[0], A), with_probabilities(parts[1], B)])
    found = associate(frames, rows, PLANE)
    assert found[2][0].class_probabilities == pytest.approx(expected([np.log(A), np.log(A), np.log(B)], 3))


def test_more_views_come_before_a_higher_score():
    left, right = boxes((30, 60), (90, 120))
    certain = np.array([0.0, 0.0, 0.0, 1.0, 0.0])
    rows = [[with_probabilities(left, A), with_probabilities(right, certain)], [with_probabilities(left, A)]]
    (first, second) = associate([from_above(left, right)] * 2, rows, PLANE)[0]
    assert (first.instance_id, second.instance_id) == (0, 1) and first.score < second.score


def test_outliers_of_a_mask_do_not_stretch_its_footprint():
    left, right = boxes((20, 60), (80, 120))
    stray = left.copy()
    stray[57:64, 140:147] = True  # 9 of 1,305 pixels after erosion
    frames = [from_above(stray), from_above(right)]
    found = associate(frames, [[with_probabilities(stray, A)], [with_probabilities(right, A)]], PLANE)
    assert {d.instance_id for row in found for d in row} == {0, 1}


def test_table_pixels_of_a_mask_are_not_part_of_its_footprint():
    (left, right), (wide_left, wide_right) = boxes((30, 60), (90, 120)), boxes((5, 85), (65, 145))
    frames = [from_above(left), from_above(right)]
    rows = [[with_probabilities(wide_left, A)], [with_probabilities(wide_right, A)]]
    assert {d.instance_id for row in associate(frames, rows, PLANE) for d in row} == {0, 1}


def test_only_points_above_the_table_have_to_be_visible_in_other_views():
    """Half of the mask is table; another view shows the block, while something covers the table beside it."""
    (block, wide) = boxes((40, 80), (40, 120))
    depth = from_above(block).depth.copy()
    depth[:, 80:] = 0.8
    rows = [[with_probabilities(wide, A)], []]
    found = associate([from_above(block), replace(from_above(block), depth=depth)], rows, PLANE)
    assert found[0][0].class_probabilities[0] == pytest.approx(MISSED)
