"""The detector with the shipped weights on scenes in closed form, and its contract with any weights."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from perception.detection.axis import log_odds
from perception.detection.crop_network import create_network, save_crop_network
from perception.detection.crops import crop
from perception.detection.detector import Detector
from perception.detection.predictors import load_scene_predictor
from perception.detection.scene_network import SceneNet, save_scene_network
from perception.detection.tasks import OUTPUTS
from perception.errors import PerceptionError
from perception.support.surface import SupportSurface
from perception.types import (
    CATEGORIES,
    POSED_CLASSES,
    ObjectDetection,
    RgbdFrame,
    SupportPlane,
    unclassified,
)

PLANE = SupportPlane()


def fixed(logits):
    """Return a network that predicts the same probabilities for every crop."""
    p = np.exp(logits) / np.exp(logits).sum()
    return lambda images, context: np.tile(p, (len(images), 1))


def fixed_detector(class_logits, yaw_bin=0, pose=0, axis_bin=0):
    yaw, axis = (20.0 * np.eye(OUTPUTS["yaw"])[number] for number in (yaw_bin, axis_bin))
    networks = (fixed(class_logits), fixed(yaw), fixed(10.0 * np.eye(10)[pose]), fixed(axis))
    return Detector(load_scene_predictor(), *networks)


def given(detector, scene):
    """What the detector says of the true masks."""
    return detector.classify(scene.frame, PLANE, [scene.instances == k for k in (0, 1)])


@pytest.fixture(scope="module")
def shipped():
    return Detector.load()


@pytest.fixture
def two(scenes):
    solids = [
        scenes.Solid(0.40, -0.25, 0.12, radius=0.033),
        scenes.Solid(0.52, -0.20, 0.06, half=(0.06, 0.04)),
    ]
    return scenes.render(solids, scenes.orbit((0.46, -0.22, 0.05), 0.5, 50, 70), 0.002, size=(640, 480))


def test_the_shipped_detector_tells_a_can_from_a_carton(shipped, two):
    detections = [d for d in shipped(two.frame, PLANE) if d.score > 0.5]
    assert [d.category for d in detections] == ["can"]
    true = two.instances == 0
    assert (detections[0].mask & true).sum() / (detections[0].mask | true).sum() > 0.9
    assert detections[0].class_probabilities.sum() == pytest.approx(1.0)


def test_nothing_in_view_is_no_detection(shipped, scenes):
    frame = scenes.render([], scenes.orbit((0.46, -0.22, 0.05), 0.5, 50, 70)).frame
    assert shipped(frame, PLANE) == []
    blind = RgbdFrame(0.0, frame.rgb, 0 * frame.depth, frame.intrinsics, frame.T_world_camera)
    assert shipped(blind, PLANE) == []


def test_doubtful_instances_stay_with_a_low_score_and_certain_others_go(two):
    doubtful = given(fixed_detector([1.0, 0.0, 0.0, 0.0, 1.5]), two)
    assert len(doubtful) == 2
    assert all(d.category == "mug" and d.score < 0.5 for d in doubtful)
    assert given(fixed_detector([0.0, 0.0, 0.0, 0.0, 9.0]), two) == []


def test_what_is_left_out_has_a_reason(two):
    table = np.array([[0.2, -0.5], [0.7, -0.5], [0.7, 0.1], [0.2, 0.1]])
    detector = fixed_detector([0.0, 0.0, 0.0, 3.0, 0.0])
    found, left_out = detector.examine(two.frame, [SupportSurface(PLANE, table)])
    assert [d.category for d in found][:1] == ["can"] and len(found) + len(left_out) == 2
    found, left_out = fixed_detector([0.0, 0.0, 0.0, 0.0, 99.0]).examine(two.frame, [SupportSurface(PLANE)])
    assert "of none of the classes" in {c.reason for c in left_out} and len(found) + len(left_out) == 2
    small = SupportSurface(PLANE, np.array([[0.3, -0.4], [0.46, -0.4], [0.46, -0.1], [0.3, -0.1]]))
    (can,), left_out = detector.examine(two.frame, [small])
    assert can.support == 0 and [c.reason for c in left_out] == ["beyond the edge of the support surface"]
    assert (left_out[0].mask & (two.instances == 1)).sum() > 1000


def test_objects_of_another_surface_are_neither_found_nor_left_out(two):
    above = SupportSurface(SupportPlane(offset=-0.3))
    detector = fixed_detector([3.0, 0.0, 0.0, 0.0, 0.0])
    assert len(detector.examine(two.frame, [SupportSurface(PLANE), above], 0)[0]) == 2
    found, left_out = detector.examine(two.frame, [SupportSurface(PLANE), above], 1)
    assert not found and not left_out


def test_yaw_is_given_in_the_world_for_what_may_be_a_mug(two):
    (first, _) = given(fixed_detector([3.0, 0.0, 0.0, 0.0, 0.0]), two)
    # The handle points straight away from the camera, which stands at azimuth 70 degrees: yaw 250.
    peak = first.yaw_probabilities.argmax() * 360 / OUTPUTS["yaw"]
    assert peak == pytest.approx(250, abs=15)
    assert first.yaw_probabilities.sum() == pytest.approx(1.0)
    (can, _) = given(fixed_detector([0.0, 0.0, 0.0, 9.0, 0.0]), two)
    assert can.category == CATEGORIES[3] and len(can.yaw_probabilities) == 0


def test_what_the_scene_network_says_of_the_classes_counts_a_third(two):
    masks = [two.instances == 0]
    (alone,) = fixed_detector([0.0, 0.0, 2.0, 0.0, 0.0]).classify(two.frame, PLANE, masks)
    assert alone.category == "bottle"
    bowl = np.array([0.0, 20.0, 0.0, 0.0, 0.0])
    (both,) = fixed_detector([0.0, 0.0, 2.0, 0.0, 0.0]).classify(two.frame, PLANE, masks, [bowl])
    assert both.category == "bowl"
    mean = 0.65 * np.array([0.0, 0.0, 2.0, 0.0, 0.0]) + 0.35 * bowl
    assert both.class_probabilities == pytest.approx(np.exp(mean) / np.exp(mean).sum(), abs=1e-4)


def test_most_certain_first(shipped, two):
    scores = [d.score for d in shipped(two.frame, PLANE)]
    assert scores == sorted(scores, reverse=True)


def test_weights_from_a_folder(tmp_path):
    save_scene_network(SceneNet(), tmp_path / "scene.safetensors")
    for task, name in (("class", "detector"), ("pose", "pose"), ("yaw", "yaw"), ("axis", "axis")):
        save_crop_network(create_network(task), tmp_path / f"{name}.safetensors", task, 1.5)
    assert Detector.load(directory=tmp_path).class_network.temperature == 1.5
    with pytest.raises(PerceptionError, match="are missing"):
        Detector.load(directory=tmp_path / "elsewhere")


def test_given_classes_stay_and_missing_ones_and_yaws_are_added(two):
    """The networks say mug and yaw bin 9 of every crop."""
    detector = fixed_detector([3.0, 0.0, 0.0, 0.0, 0.0], yaw_bin=9)
    first, second = (two.instances == k for k in (0, 1))
    detections = [
        ObjectDetection("bowl", 0.6, first, instance_id=8),
        ObjectDetection("mug", 0.6, first, instance_id=9),
        unclassified(second, 7),
        ObjectDetection("mug", 0.5, first, yaw_probabilities=np.full(36, 1 / 36)),
    ]
    bowl, mug, named, told = detector.complete(two.frame, PLANE, detections)
    assert bowl is detections[0] and told is detections[3]
    assert (mug.category, mug.score, mug.instance_id, mug.class_probabilities.size) == ("mug", 0.6, 9, 0)
    assert (named.category, named.instance_id) == ("mug", 7)
    assert named.score == pytest.approx(np.exp(3) / (np.exp(3) + 4))
    (reference, *_) = given(detector, two)
    np.testing.assert_allclose(mug.yaw_probabilities, reference.yaw_probabilities, atol=1e-6)
    assert named.yaw_probabilities.sum() == pytest.approx(1.0)


def test_masks_without_depth_are_not_completed(two):
    frame = RgbdFrame(0.0, two.frame.rgb, 0 * two.frame.depth, two.frame.intrinsics, two.frame.T_world_camera)
    detections = [ObjectDetection("mug", 0.6, two.instances == 0), unclassified(two.instances == 1)]
    assert fixed_detector([3.0, 0.0, 0.0, 0.0, 0.0]).complete(frame, PLANE, detections) == detections


def test_poses_are_named_for_all_masks_with_depth(two):
    masks = [two.instances == k for k in (0, 1)]
    near = cv2.dilate(masks[1].astype(np.uint8), np.ones((9, 9))) > 0  # filters fill small gaps
    blind = replace(two.frame, depth=np.where(near & ~masks[0], 0, two.frame.depth))
    found = [ObjectDetection("can", 0.9, mask, instance_id=k) for k, mask in enumerate(masks)]
    named, unseen = fixed_detector(np.zeros(5), pose=3).posed(blind, PLANE, found)
    assert named.pose_probabilities.argmax() == 3
    np.testing.assert_allclose(named.pose_probabilities.max(), 1 / (1 + 9 * np.exp(-10.0)))
    assert (named.category, named.instance_id) == ("can", 0) and unseen is found[1]


@pytest.mark.parametrize("posed", POSED_CLASSES)
def test_the_direction_of_the_axis_is_estimated_of_what_lies(two, posed):
    """Bin 9 of the network is a quarter turn left of up in the crop, which is the way the camera looks."""
    found = [ObjectDetection("can", 0.9, two.instances == 0)]
    detector = fixed_detector(np.zeros(5), pose=POSED_CLASSES.index(posed), axis_bin=9)
    (named,) = detector.posed(two.frame, PLANE, found)
    if posed[1] != "lying":
        assert named.axis_probabilities.size == 0
        return
    heading = crop(two.frame, found[0].mask, PLANE).heading
    left = np.array([-heading[1], heading[0]])
    assert log_odds(named.axis_probabilities, left) > 3
    assert named.axis_probabilities.sum() == pytest.approx(1.0)
