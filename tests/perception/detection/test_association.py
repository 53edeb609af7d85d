"""Objects tied across crossing views, and what the views decide together."""

import numpy as np
import pytest

from perception.detection.association import associate
from perception.detection.yaw import modes, soft_labels
from perception.errors import InvalidInputError
from perception.types import CATEGORIES, ObjectDetection, RgbdFrame, SupportPlane

PLANE = SupportPlane()
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


def owners(result, scan):
    """Instance id of each solid, per view."""
    rows = []
    for scene, detections in zip(scan, result):
        row = {}
        for d in detections:
            solids = scene.instances[d.mask & (scene.instances >= 0)]
            row[int(np.bincount(solids).argmax())] = d.instance_id
        rows.append(row)
    return rows


def test_crossing_views_tie_what_belongs_together(scan):
    detections = true_detections(scan)
    shuffled = [row[k:] + row[:k] for k, row in enumerate(detections)]
    rows = owners(associate(frames_of(scan), shuffled, PLANE), scan)
    assert all(row == rows[0] for row in rows)
    assert sorted(rows[0].values()) == [0, 1, 2]


def test_classes_are_voted_with_their_certainty(scan):
    detections = true_detections(scan)
    for view, (category, p) in enumerate((("can", 0.9), ("bottle", 0.6), ("can", 0.7), ("bottle", 0.5))):
        detections[view][0] = detection(scan[view].instances == 0, category, p)
    result = associate(frames_of(scan), detections, PLANE)
    voted = [d for row in result for d in row if d.instance_id == owners(result, scan)[0][0]]
    assert {d.category for d in voted} == {"can"}
    assert len({d.score for d in voted}) == 1
    assert voted[0].class_probabilities.sum() == pytest.approx(1.0)
    clear = associate(frames_of(scan), true_detections(scan, p=0.9), PLANE)
    assert voted[0].score < clear[0][0].score  # disagreement costs certainty


def test_what_is_most_probably_of_no_class_goes(scan):
    detections = true_detections(scan)
    for view, (category, p) in enumerate((("other", 0.7), ("can", 0.5), ("other", 0.7), ("other", 0.6))):
        detections[view][1] = detection(scan[view].instances == 1, category, p)
    result = associate(frames_of(scan), detections, PLANE)
    assert [len(row) for row in result] == [2, 2, 2, 2]
    assert all(set(row) == {0, 2} for row in owners(result, scan))


def test_views_that_left_it_out_count_as_votes_against(scan):
    detections = true_detections(scan)
    for view in (1, 2, 3):
        detections[view].pop(1)
    detections[0][1] = detection(scan[0].instances == 1, "can", 0.5)
    result = associate(frames_of(scan), detections, PLANE)
    assert len(result[0]) == 2


def test_a_view_that_merges_what_others_separate_is_not_used(scan):
    detections = true_detections(scan)
    both = (scan[1].instances == 0) | (scan[1].instances == 1)
    detections[1] = [detection(both), detections[1][2]]
    rows = owners(associate(frames_of(scan), detections, PLANE), scan)
    assert [len(row) for row in rows] == [3, 1, 3, 3]
    assert rows[0] == rows[2] == rows[3]


def test_parts_of_what_others_see_whole_are_united(scan):
    detections = true_detections(scan)
    whole = scan[2].instances == 2
    left = whole & (np.arange(640) < np.nonzero(whole)[1].mean())
    detections[2] = [*detections[2][:2], detection(left), detection(whole & ~left)]
    result = associate(frames_of(scan), detections, PLANE)
    assert [len(row) for row in result] == [3, 3, 3, 3]
    assert any(np.array_equal(d.mask, whole) for d in result[2])


def test_yaw_of_mugs_is_the_product_of_the_views(scan):
    spread = soft_labels(np.array([1.2]), spread=0.5)[0]
    mirrored = 0.5 * spread + 0.5 * soft_labels(np.array([4.0]), spread=0.5)[0]  # in doubt between two
    detections = [
        [detection(s.instances == 0, "mug", 0.9, yaw)]
        for s, yaw in zip(scan, (mirrored, spread, mirrored, spread))
    ]
    result = associate(frames_of(scan), detections, PLANE)
    fused = result[0][0].yaw_probabilities
    assert all(np.array_equal(row[0].yaw_probabilities, fused) for row in result)
    (yaw, _), *_ = modes(fused)
    assert yaw == pytest.approx(1.2, abs=0.05)


def test_symmetric_classes_carry_no_yaw(scan):
    yaw = soft_labels(np.array([1.2]))[0]
    detections = [[detection(s.instances == 0, "can", 0.9, yaw)] for s in scan]
    assert len(associate(frames_of(scan), detections, PLANE)[0][0].yaw_probabilities) == 0


def test_detections_that_know_only_a_category_vote_with_their_score(scan):
    detections = [[ObjectDetection("bowl", 0.9, s.instances == 2)] for s in scan]
    result = associate(frames_of(scan), detections, PLANE)
    assert all(row[0].category == "bowl" and row[0].score > 0.9 for row in result)


def test_what_is_longer_than_any_object_goes(scan, scenes):
    wall = scenes.Solid(0.5, 0.0, 0.08, half=(0.25, 0.01))
    seen = scenes.render([wall], scenes.orbit((0.5, 0.0, 0.0), 0.8, 80, 90))
    assert associate([seen.frame], [[detection(seen.instances == 0)]], PLANE) == [[]]


def test_single_frames_and_empty_lists_work(scan):
    (alone,) = associate(frames_of(scan)[:1], true_detections(scan)[:1], PLANE)
    assert sorted(d.instance_id for d in alone) == [0, 1, 2]
    assert associate(frames_of(scan), [[], [], [], []], PLANE) == [[], [], [], []]


def test_inputs_are_checked(scan):
    with pytest.raises(InvalidInputError, match="4 frames but detections for 1"):
        associate(frames_of(scan), [[]], PLANE)
    f = scan[0].frame
    unposed = RgbdFrame(0.0, f.rgb, f.depth, f.intrinsics)
    with pytest.raises(InvalidInputError, match="needs T_world_camera"):
        associate([unposed, unposed], [[], []], PLANE)
