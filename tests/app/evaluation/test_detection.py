"""Figures of the detection evaluation by hand, and one small chunk from rendering to the table."""

from types import SimpleNamespace

import numpy as np
import pytest

import app.evaluation.detection as detection
from app.evaluation.detection_scoring import average_precision, score_image, summarise_detection
from app.options import EvaluateOptions
from app.screen import Screen
from perception.detection.yaw import soft_labels
from perception.types import CATEGORIES, CameraIntrinsics, ObjectDetection, RgbdFrame

K = CameraIntrinsics(320, 240, 290.0, 290.0, 159.5, 119.5)
T_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
T_DOWN[2, 3] = 0.5


def disc(x, y, radius):
    v, u = np.mgrid[:240, :320]
    return np.hypot(u - x, v - y) < radius


def picture(things):
    """Discs seen from above; a thing is (class or None, u, v, radius, yaw, area of the outline or None)."""
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
    ("bottle", 250, 190, 12, 0.0, 5000.0),  # mostly hidden: does not count
]


def test_a_perfect_detector_scores_perfectly():
    image = picture(THINGS)
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


def test_every_kind_of_error_shows_in_its_figure():
    image = picture(THINGS)
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


def test_objects_called_other_are_found_but_of_the_wrong_class():
    image = picture(THINGS[:2])
    line = score_image(image, [found(None, image.instances == 0), found("can", image.instances == 1)])
    m = summarise_detection([line])
    assert m["recall"] == 1.0 and m["class_accuracy"] == 0.5 and m["confusion"][0][4] == 1
    assert len(line["detections"]) == 1
    nothing = summarise_detection([score_image(image, [])])
    assert nothing["recall"] == nothing["ap50"] == nothing["mean_iou"] == 0.0


def test_a_chunk_from_rendering_to_the_table(tmp_path, monkeypatch):
    from sim_assets.datasets.table_top import TrainingSceneConfig

    small = TrainingSceneConfig(
        width=640, height=480, pool=4, distractors=2, objects=(3, 4), extras=(1, 1), textures_redrawn=2
    )
    monkeypatch.setattr(detection, "_scenes", lambda _: small)
    options = EvaluateOptions(
        what="detection", images=2, renderer="classic", out=tmp_path, device="cpu", seed=4, quiet=True
    )
    report = detection.run(options, Screen(quiet=True))
    assert report.success and report.metrics["images"] == 2 and report.metrics["objects"] > 2
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 2
    assert detection.detection_table(report.metrics).row_count == 14
    again = detection.run(
        EvaluateOptions(
            what="detection", images=2, renderer="classic", out=tmp_path, device="cpu", seed=4, resume=True
        ),
        Screen(quiet=True),
    )
    assert again.metrics["map50"] == report.metrics["map50"] and again.timings["total"] < 5
