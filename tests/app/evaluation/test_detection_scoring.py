"""Metrics of the detection evaluation, computed by hand on images of discs."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.evaluation.detection_scoring import (
    average_precision,
    is_accepted,
    score_image,
    summarise_detection,
)
from perception.detection.yaw import soft_labels
from perception.types import CATEGORIES, CameraIntrinsics, ObjectDetection, RgbdFrame

K = CameraIntrinsics(320, 240, 290.0, 290.0, 159.5, 119.5)
T_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
T_DOWN[2, 3] = 0.5


def disc(x, y, radius):
    v, u = np.mgrid[:240, :320]
    return np.hypot(u - x, v - y) < radius


def labelled_image(things):
    """Return discs seen from above, given as (class or None, u, v, radius, yaw, outline area or None)."""
    instances, labels = np.full((240, 320), -1), []
    for k, (category, u, v, radius, yaw, outline) in enumerate(things):
        instances[disc(u, v, radius)] = k
        pixels = int((instances == k).sum())
        labels.append(
            SimpleNamespace(
                category=category,
                yaw=yaw,
                pixels=pixels,
                outline_pixels=outline or pixels,
                T_world_object=np.eye(4),
            )
        )
    depth = np.full((240, 320), 0.5, np.float32)
    frame = RgbdFrame(0.0, np.zeros((240, 320, 3), np.uint8), depth, K, T_DOWN)
    return SimpleNamespace(frame=frame, instances=instances, labels=tuple(labels))


def found(category, mask, score=0.9, yaw=None):
    p = np.full(5, (1 - score) / 4)
    p[4 if category is None else CATEGORIES.index(category)] = score
    bins = np.zeros(0) if yaw is None else soft_labels(np.array([yaw]))[0].astype(np.float64)
    return ObjectDetection(category or "mug", float(p[:4].max()), mask, p, bins)


THINGS = [
    ("mug", 60, 60, 30, 1.0, None),
    ("can", 160, 60, 25, 0.0, None),
    ("bowl", 260, 60, 30, 0.0, None),
    (None, 60, 180, 30, 0.0, None),
    ("bottle", 250, 190, 12, 0.0, 5000.0),  # mostly occluded: ignored
]


def test_a_perfect_detector_scores_perfectly():
    image = labelled_image(THINGS)
    right = [
        found(c, image.instances == k, yaw=1.1 if c == "mug" else None) for k, (c, *_) in enumerate(THINGS)
    ]
    m = summarise_detection([score_image(image, right) | {"seconds": 0.1}])
    assert m["objects"] == 3 and m["distractors"] == 1
    for name in ("ap50", "map50", "map", "recall", "mean_iou", "class_accuracy"):
        assert m[name] == pytest.approx(1.0), name
    assert m["distractors_taken_for_objects"] == 0.0 and m["seconds"] == 0.1
    assert [row["objects"] for row in m["class_accuracy_by_visible"]] == [0, 0, 0, 3]
    assert m["class_accuracy_by_visible"][-1]["class_accuracy"] == 1.0
    yaw = m["yaw"]["visible"]["median"] + m["yaw"]["hidden"]["median"]
    assert yaw == pytest.approx(0.1, abs=0.02)


def test_each_error_changes_its_own_metric():
    image = labelled_image(THINGS)
    wrong = [
        found("bowl", image.instances == 0),  # a mug taken for a bowl
        found("can", disc(170, 60, 25)),  # shifted by 10: IoU 0.59
        found("can", image.instances == 3),  # the distractor taken for a can; the bowl is missed
    ]
    line = score_image(image, wrong)
    m = summarise_detection([line])
    assert m["recall"] == pytest.approx(2 / 3) and m["class_accuracy"] == 0.5
    assert m["confusion"][0] == [0, 1, 0, 0, 0] and m["distractors_taken_for_objects"] == 1.0
    a, b = image.instances == 1, disc(170, 60, 25)
    assert m["mean_iou"] == pytest.approx((1 + (a & b).sum() / (a | b).sum()) / 2)
    assert m["map50"] < m["ap50"] < 1 and average_precision([line], by_class=True)[1] < m["map50"]


def test_objects_classified_as_other_are_matched_but_of_the_wrong_class():
    image = labelled_image(THINGS[:2])
    line = score_image(image, [found(None, image.instances == 0), found("can", image.instances == 1)])
    m = summarise_detection([line])
    assert m["recall"] == 1.0 and m["class_accuracy"] == 0.5 and m["confusion"][0][4] == 1
    assert len(line["detections"]) == 1
    nothing = summarise_detection([score_image(image, [])])
    assert nothing["recall"] == nothing["ap50"] == nothing["mean_iou"] == 0.0


@pytest.mark.parametrize(
    ("radius", "outline", "counts"),
    [(11, None, True), (9, None, False), (20, 5100.0, False), (20, 4900.0, True)],
)
def test_objects_count_from_300_pixels_and_a_quarter_of_their_outline(radius, outline, counts):
    image = labelled_image([("can", 100, 100, radius, 0.0, outline), (None, 200, 100, radius, 0.0, outline)])
    line = score_image(image, [])
    assert [entry["counts"] for entry in line["objects"]] == [counts]
    assert len(line["distractors"]) == int(counts)


@pytest.mark.parametrize(("shift", "matched"), [(12, True), (16, False)])
def test_a_detection_matches_above_an_iou_of_one_half(shift, matched):
    image = labelled_image([("can", 100, 100, 25, 0.0, None)])  # shifts of 12 and 16 px: IoU 0.53 and 0.42
    entry = score_image(image, [found("can", disc(100 + shift, 100, 25))])["objects"][0]
    assert (entry["found"] == "can") is matched


@pytest.mark.parametrize(("shift", "taken"), [(15, True), (28, False)])
def test_a_distractor_is_taken_for_an_object_by_half_of_a_detection(shift, taken):
    image = labelled_image([(None, 100, 100, 25, 0.0, None)])
    line = score_image(image, [found("bowl", disc(100 + shift, 100, 25))])
    assert line["distractors"][0]["taken"] is taken
    assert not score_image(image, [found(None, image.instances == 0)])["distractors"][0]["taken"]


def test_a_detection_without_class_probabilities_is_accepted():
    mask = disc(60, 60, 20)
    assert is_accepted(ObjectDetection("mug", 0.3, mask))
    assert is_accepted(found("mug", mask, 0.5)) and not is_accepted(found(None, mask, 0.5))


def test_ignored_objects_are_neither_missed_nor_false_positives():
    image = labelled_image(THINGS)
    right = [found(c, image.instances == k) for k, (c, *_) in enumerate(THINGS[:3])]
    on_ignored = found("bottle", image.instances == 4, 0.99)
    lines = [score_image(image, [*right, on_ignored])]
    assert average_precision(lines, by_class=False)[0] == pytest.approx(1.0)
    lines = [score_image(image, [*right, found("bottle", disc(160, 180, 20), 0.99)])]
    assert average_precision(lines, by_class=False)[0] < 0.9


def test_accuracy_by_visible_share_uses_half_open_bins():
    image = labelled_image(
        [("can", 60 + 60 * k, 100, 20, 0.0, 1256 / share) for k, share in enumerate((0.3, 0.6, 0.8, 0.95))]
    )
    right = [found("can" if k else "bowl", image.instances == k) for k in range(4)]
    rows = summarise_detection([score_image(image, right)])["class_accuracy_by_visible"]
    assert [(row["from"], row["objects"]) for row in rows] == [(0.25, 1), (0.5, 1), (0.75, 1), (0.9, 1)]
    assert [row["class_accuracy"] for row in rows] == [0.0, 1.0, 1.0, 1.0]


def test_a_known_yaw_replaces_the_mode_of_the_distribution() -> None:
    image = labelled_image(THINGS)
    row = [
        found(c, image.instances == k, yaw=1.1 if c == "mug" else None) for k, (c, *_) in enumerate(THINGS)
    ]
    line = score_image(image, row, [1.0 + 0.3] * len(row))
    errors = [entry["yaw"]["error"] for entry in line["objects"] if "yaw" in entry]
    assert errors == [pytest.approx(0.3)]


def yaw_line(*rows):
    entries = [
        {"counts": True, "found": "mug", "category": "mug", "visible": 1.0, "iou": 1.0,
         "yaw": {"error": np.radians(error), "handle": handle, "entropy": entropy, "mass": 1.0}}
        for error, handle, entropy in rows
    ]  # fmt: skip
    for entry in entries:
        entry |= {"mask": {"size": [1, 1], "counts": "01"}, "pixels": 1}
    return {"objects": entries, "distractors": [], "detections": []}


def test_yaw_errors_are_split_by_the_visibility_of_the_handle():
    line = yaw_line((14, 0.02, 1.0), (16, 0.05, 2.0), (31, 0.04, 3.0), (90, 0.009, 4.0))
    yaw = summarise_detection([line])["yaw"]
    assert (yaw["visible"]["mugs"], yaw["clear"]["mugs"], yaw["hidden"]["mugs"]) == (3, 2, 1)
    assert yaw["visible"]["over_15_degrees"] == pytest.approx(2 / 3)
    assert yaw["visible"]["over_30_degrees"] == pytest.approx(1 / 3)
    assert yaw["visible"]["median"] == pytest.approx(np.radians(16)) and yaw["visible"]["entropy"] == 2.0
    assert yaw["hidden"]["median"] == pytest.approx(np.radians(90))
    assert yaw["clear"]["quantile_95"] == pytest.approx(np.radians(16 + 0.95 * 15))


@pytest.mark.parametrize(("true", "predicted"), [(1.0, 1.3), (3.0, -3.0), (-0.2, 0.2)])
def test_the_yaw_error_is_the_smallest_angle_between_prediction_and_truth(true, predicted):
    image = labelled_image([("mug", 100, 100, 30, true, None)])
    entry = score_image(image, [found("mug", image.instances == 0, yaw=predicted)])["objects"][0]
    error = abs((predicted - true + np.pi) % (2 * np.pi) - np.pi)
    assert entry["yaw"]["error"] == pytest.approx(error, abs=0.01)
