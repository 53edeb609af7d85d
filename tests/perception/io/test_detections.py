"""``detections.json``: round trip, run-length codes, invalid entries."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycocotools import mask as coco

from perception.errors import InvalidInputError
from perception.io import detections
from perception.io.detections import (
    MAX_PER_IMAGE,
    decode_detections,
    decode_mask,
    encode_detections,
    encode_mask,
    read_detection_entries,
    read_detections,
    write_detections,
)
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame, is_unclassified

H, W = 24, 32
FRAME = RgbdFrame(
    0.0,
    np.zeros((H, W, 3), np.uint8),
    np.ones((H, W), np.float32),
    CameraIntrinsics(W, H, 30.0, 31.0, 15.5, 11.5),
)
FRAMES = {0: FRAME, 3: FRAME}


def detection(**changes):
    mask = np.zeros((H, W), bool)
    mask[3:9, 5:20] = True
    mask[5, 7] = False
    fields = {"category": "mug", "score": 0.9, "mask": mask, "instance_id": 4}
    return ObjectDetection(**(fields | changes))


def read(folder):
    return read_detections(folder, FRAMES, {0, 1, 2, 3})


@pytest.fixture
def folder(tmp_path):
    found = detection(
        yaw_probabilities=np.full(4, 0.25), class_probabilities=np.array([0.9, 0.04, 0.03, 0.02, 0.01])
    )
    write_detections(tmp_path, [[found], [detection()], [], [detection(category="can", instance_id=None)]])
    return tmp_path


def test_detections_of_usable_images_are_read(folder):
    first, last = read(folder)
    assert [(d.category, d.score, d.instance_id) for d in first] == [("mug", 0.9, 4)]
    np.testing.assert_array_equal(first[0].mask, detection().mask)
    np.testing.assert_allclose(first[0].yaw_probabilities, 0.25)
    np.testing.assert_allclose(first[0].class_probabilities, [0.9, 0.04, 0.03, 0.02, 0.01])
    assert [(d.category, d.instance_id) for d in last] == [("can", None)]


def test_a_folder_without_detections(tmp_path):
    assert read(tmp_path) is None


def test_encoded_entries_decode_to_the_same_detections(tmp_path):
    sent = [detection(), detection(category="bowl", score=0.5)]
    entries = encode_detections(7, sent)
    assert [(index, entry["image_id"]) for index, entry in entries] == [(0, 7), (1, 7)]
    got = decode_detections(tmp_path, entries, 7, FRAME)
    assert [(d.category, d.score) for d in got] == [("mug", 0.9), ("bowl", 0.5)]


def test_missing_scores_are_certain(folder):
    entries = json.loads((folder / "detections.json").read_text())
    del entries[0]["score"]
    (folder / "detections.json").write_text(json.dumps(entries))
    assert read(folder)[0][0].score == 1.0


def test_the_class_may_be_missing_in_a_scan(folder, tmp_path):
    entries = json.loads((folder / "detections.json").read_text())
    del entries[1]["category_name"]
    (folder / "detections.json").write_text(json.dumps(entries[:2]))
    ((named,), _) = read(folder)
    assert named.category == "mug" and not is_unclassified(named)
    entries[1]["image_id"] = 0
    (folder / "detections.json").write_text(json.dumps(entries[:2]))
    ((_, bare), _) = read(folder)
    assert is_unclassified(bare) and bare.instance_id == 4
    with pytest.raises(InvalidInputError, match="category_name None is none of"):
        decode_detections(tmp_path, [(0, entries[1])], 0, FRAME)


@pytest.mark.parametrize("score", [-0.01, 1.01, True, "high"])
def test_scores_are_numbers_in_0_to_1(folder, score):
    entries = json.loads((folder / "detections.json").read_text())
    entries[0]["score"] = score
    (folder / "detections.json").write_text(json.dumps(entries))
    with pytest.raises(InvalidInputError, match=r"must be a number in 0\.\.1"):
        read(folder)


BAD_DETECTIONS = {
    "no list": (lambda d: {"mask": 1}, "must be a list"),
    "unknown class": (
        lambda d: [d[0] | {"category_name": "spoon"}],
        "'spoon' is none of mug, bowl, bottle, can",
    ),
    "no class": (lambda d: [d[0] | {"category_name": ["mug"]}], "is none of"),
    "unknown image": (lambda d: [d[0] | {"image_id": 77}], "image_id 77 is not in scene_camera.json"),
    "image is a list": (lambda d: [d[0] | {"image_id": [0]}], r"image_id \[0\] is not in"),
    "score": (lambda d: [d[0] | {"score": float("nan")}], "detections.json holds NaN"),
    "instance": (lambda d: [d[0] | {"instance_id": "first"}], "instance_id 'first' must be"),
    "size": (
        lambda d: [d[0] | {"segmentation": encode_mask(np.ones((4, 4), bool))}],
        r"mask has size \[4, 4\] but the image has \[24, 32\]",
    ),
    "cut short": (lambda d: cut(d, lambda counts: counts[:-2]), "run-length code"),
    "garbage": (lambda d: cut(d, lambda counts: "\u20ac"), "do not decode"),
    "runs that are no whole numbers": (lambda d: cut(d, lambda counts: [0.9, H * W]), "do not decode"),
    "negative runs": (lambda d: cut(d, lambda counts: [-5, H * W + 5]), "damaged"),
    "no mask": (lambda d: [d[0] | {"segmentation": None}], "must be a COCO run-length code"),
    "polygons": (lambda d: [d[0] | {"segmentation": [[0, 0, 4, 4]]}], "must be a COCO run-length code"),
    "empty mask": (lambda d: cut(d, lambda counts: [H * W]), "mask of a mug is empty"),
    "too few classes": (
        lambda d: [d[0] | {"class_probabilities": [0.5, 0.5]}],
        "must hold 5 to 5 numbers, not 2",
    ),
    "sum": (
        lambda d: [d[0] | {"class_probabilities": [0.6] * 5}],
        "class_probabilities must sum to 1, not to 3",
    ),
    "one bin": (lambda d: [d[0] | {"yaw_probabilities": [1]}], "must hold 2 to 720 numbers, not 1"),
    "yaw": (lambda d: [d[0] | {"yaw_probabilities": ["north"]}], "yaw_probabilities must be"),
}


def cut(entries, change):
    entries[0]["segmentation"]["counts"] = change(entries[0]["segmentation"]["counts"])
    return entries


@pytest.mark.parametrize("damage, message", BAD_DETECTIONS.values(), ids=BAD_DETECTIONS)
def test_bad_detections(folder, damage, message):
    path = folder / "detections.json"
    path.write_text(json.dumps(damage(json.loads(path.read_text()))))
    with pytest.raises(InvalidInputError, match=message) as caught:
        read(folder)
    assert "detections.json" in str(caught.value) and "delete it" in str(caught.value)


def test_runs_count_down_the_columns_and_begin_with_background():
    """The example of the COCO API: 2 x 3, the lower left and the two right pixels set."""
    code = {"size": [2, 3], "counts": [1, 1, 2, 2]}
    np.testing.assert_array_equal(decode_mask(code, (2, 3)), [[False, False, True], [True, False, True]])


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_masks_survive_and_agree_with_pycocotools(height, width, seed, density):
    mask = np.random.default_rng(seed).random((height, width)) < density
    code = encode_mask(mask)
    np.testing.assert_array_equal(decode_mask(json.loads(json.dumps(code)), (height, width)), mask)
    np.testing.assert_array_equal(coco.decode(code), mask)


def test_more_detections_of_an_image_than_the_limit_are_refused_before_any_is_decoded(tmp_path):
    entries = [{"image_id": 3}] * MAX_PER_IMAGE
    (tmp_path / "detections.json").write_text(json.dumps(entries))
    assert len(read_detection_entries(tmp_path, {3})[3]) == MAX_PER_IMAGE
    (tmp_path / "detections.json").write_text(json.dumps([*entries, {"image_id": 3}] * 50))
    with pytest.raises(
        InvalidInputError, match=rf"image 3 has more than {MAX_PER_IMAGE} detections: keep the best"
    ):
        read(tmp_path)


def test_masks_beyond_the_memory_limit_are_refused_before_any_is_decoded(tmp_path, monkeypatch):
    write_detections(tmp_path, [[detection()] * 2, [], [], [detection()]])
    monkeypatch.setattr(detections, "MAX_MASK_BYTES", 3 * H * W)
    assert [len(found) for found in read(tmp_path)] == [2, 1]
    monkeypatch.setattr(detections, "MAX_MASK_BYTES", 3 * H * W - 1)
    with pytest.raises(InvalidInputError, match=r"holds masks of .* GiB are decoded: split the scan"):
        read(tmp_path)
