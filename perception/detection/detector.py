"""Detection of the objects in one RGB-D frame.

The scene network segments instances by Hough voting; a network on context crops decides
their class, with a share of the scene network; the yaw network predicts where the handles of mugs
point. In clutter the pose network tells what rests on its side or upside down, and the axis network in which
direction it lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import log_softmax, softmax

from perception.detection.crops import Crop, FrameGeometry, crop, frame_geometry, mask_core, stack_crops
from perception.detection.geometry import heading_angle
from perception.detection.instances import InstanceConfig, find_instances, segment
from perception.detection.left_out import LeftOut, of_no_class
from perception.detection.parts import CERTAIN, SHARE, continued_share
from perception.detection.poses import pose_mass
from perception.detection.predictors import (
    CropPredictor,
    ScenePredictor,
    load_crop_predictor,
    load_scene_predictor,
)
from perception.detection.tasks import SCENE_WEIGHTS_FILE, WEIGHTS_FILES, Task
from perception.detection.yaw import rotate_yaw
from perception.support.standing import MeasuredObject, StandingConfig, misplacement, support_of
from perception.support.surface import SupportSurface
from perception.types import CATEGORIES, OTHER, ObjectDetection, RgbdFrame, SupportPlane, is_unclassified

_MUG = CATEGORIES.index("mug")
SCENE_SHARE = 0.35  # weight of the scene network in the class


@dataclass(frozen=True)
class DetectorConfig:
    """Parameters of the detector.

    Attributes:
        instances: Parameters of the instance segmentation.
        standing: Tolerances for what stands on a surface.
        max_other: Largest probability of 'other' (distractors) of a detection. Well above one half, so that
            several views can still vote (``association.associate``); the score of such a detection is low.
        min_mug: Smallest probability of 'mug' for which yaw is estimated.
        min_lying: Smallest probability of lying for which the direction of the axis is estimated.
    """

    instances: InstanceConfig = field(default_factory=InstanceConfig)
    standing: StandingConfig = field(default_factory=StandingConfig)
    max_other: float = 0.9
    min_mug: float = 0.05
    min_lying: float = 0.05


@dataclass(frozen=True)
class Detector:
    """Detects mugs, bowls, bottles and cans in RGB-D frames. Create it with ``load``.

    Attributes:
        scene_network: Dense network for instances.
        class_network: Network or ensemble for the class of a crop.
        yaw_network: Network for the yaw of a mug's handle relative to the view.
        pose_network: Network for class and resting pose.
        axis_network: Network for the direction of the axis of what lies relative to the view.
        config: Parameters.
    """

    scene_network: ScenePredictor
    class_network: CropPredictor
    yaw_network: CropPredictor
    pose_network: CropPredictor
    axis_network: CropPredictor
    config: DetectorConfig = DetectorConfig()

    @staticmethod
    def load(
        device: str = "cpu",
        directory: Path | None = None,
        config: DetectorConfig = DetectorConfig(),
    ) -> Detector:
        """Return the detector with the shipped weights, or those in ``directory``.

        Raises:
            PerceptionError: Weights are missing, damaged or differ from their checksums.
        """
        scene = None if directory is None else directory / SCENE_WEIGHTS_FILE

        def on_crops(task: Task) -> CropPredictor:
            path = None if directory is None else directory / WEIGHTS_FILES[task]
            return load_crop_predictor(task, path, device)

        network = load_scene_predictor(scene, device)
        networks = (on_crops("class"), on_crops("yaw"), on_crops("pose"), on_crops("axis"))
        return Detector(network, *networks, config)

    def __call__(self, frame: RgbdFrame, plane: SupportPlane) -> list[ObjectDetection]:
        """Return the detections in a frame by descending score, without distractors.

        The score is the calibrated probability of the category. Yaw distributions are over world yaw.

        Args:
            frame: RGB-D image; without a pose its camera is the world.
            plane: Support plane in the world frame.
        """
        found = find_instances(frame, plane, self.scene_network, self.config.instances)
        scene_log_classes = [instance.log_classes for instance in found]
        return self.classify(frame, plane, [instance.mask for instance in found], scene_log_classes)

    def examine(
        self, frame: RgbdFrame, surfaces: Sequence[SupportSurface], support: int = 0
    ) -> tuple[list[ObjectDetection], list[LeftOut]]:
        """Return the objects that stand on one of several surfaces, and all other candidates.

        Args:
            frame: RGB-D image; without a pose its camera is the world.
            surfaces: Surfaces with their extents, in the world frame.
            support: Index of the surface that is examined.

        Returns:
            Detections by descending score; what was segmented and left out, with the reason. Candidates that
            stand on another of the surfaces are neither.
        """
        surface, standing = surfaces[support], self.config.standing
        instances, implausible = segment(frame, surface.plane, self.scene_network, self.config.instances)
        left_out = implausible if support == 0 else []  # relative to another plane most of them are scenery
        kept = []
        for instance in instances:
            seen = MeasuredObject.of(frame, instance.mask, standing)
            if seen is None:
                left_out.append(LeftOut(instance.mask, "no depth"))
            elif support_of(seen, surfaces, standing) == support:
                fault = misplacement(seen, surface, standing)
                kept += [] if fault else [instance]
                left_out += [fault] if fault else []
        masks, scene = [instance.mask for instance in kept], [instance.log_classes for instance in kept]
        found, refused = self._judged(frame, surface.plane, masks, scene)
        return [replace(detection, support=support) for detection in found], left_out + refused

    def classify(
        self,
        frame: RgbdFrame,
        plane: SupportPlane,
        masks: Sequence[Bool[np.ndarray, "h w"]],
        scene_log_classes: Sequence[Float[np.ndarray, "5"]] | None = None,
    ) -> list[ObjectDetection]:
        """Classify given instance masks and estimate the yaw of mugs; masks without depth are skipped.

        Args:
            frame: RGB-D image.
            plane: Support plane in the world frame.
            masks: Pixels of each instance.
            scene_log_classes: Class log-probabilities of each instance from the scene network, averaged with
                those of the class network; the class network alone decides if None.
        """
        return self._judged(frame, plane, masks, scene_log_classes)[0]

    def _judged(
        self,
        frame: RgbdFrame,
        plane: SupportPlane,
        masks: Sequence[Bool[np.ndarray, "h w"]],
        scene_log_classes: Sequence[Float[np.ndarray, "5"]] | None,
    ) -> tuple[list[ObjectDetection], list[LeftOut]]:
        """Return the detections of ``classify``, and the masks that are none."""
        geometry = frame_geometry(frame, plane)
        kept = [i for i, mask in enumerate(masks) if geometry.has_depth(mask)]
        left_out = [LeftOut(mask, "no depth") for i, mask in enumerate(masks) if i not in kept]
        if not kept:
            return [], left_out
        masks = [masks[i] for i in kept]
        classes, crops = self._classes(frame, plane, masks, geometry)
        if scene_log_classes is not None:
            scene = np.stack([scene_log_classes[i] for i in kept]).astype(np.float64)
            classes = combine_probabilities(classes, scene)
        mugs = np.flatnonzero(classes[:, _MUG] >= self.config.min_mug).tolist()
        whole = [crops[i] or crop(frame, masks[i], plane, geometry) for i in mugs]
        yaw_of = dict(zip(mugs, self._directions(self.yaw_network, whole, plane)))
        things = [mask for mask, p in zip(masks, classes) if p[OTHER] > self.config.max_other]
        detections = []
        for i, (mask, probabilities) in enumerate(zip(masks, classes)):
            if probabilities[OTHER] > self.config.max_other:
                left_out.append(of_no_class(mask, probabilities[OTHER]))
            elif probabilities[:OTHER].max() < CERTAIN and _is_part(mask, things, frame):
                left_out.append(LeftOut(mask, "part of a thing of no class"))
            else:
                detections.append(_classified(mask, probabilities, yaw_of.get(i, np.zeros(0))))
        return sorted(detections, key=lambda detection: -detection.score), left_out

    def complete(
        self, frame: RgbdFrame, plane: SupportPlane, detections: Sequence[ObjectDetection]
    ) -> list[ObjectDetection]:
        """Return the detections, in their order, with the missing classes and the missing yaws of mugs.

        Detections whose mask contains no depth stay as they are.

        Args:
            frame: RGB-D image.
            plane: Support plane in the world frame.
            detections: Detections of any source.
        """
        geometry = frame_geometry(frame, plane)
        result = list(detections)
        usable = [i for i, d in enumerate(detections) if geometry.has_depth(d.mask)]
        unnamed = [i for i in usable if is_unclassified(detections[i])]
        if unnamed:
            masks = [detections[i].mask for i in unnamed]
            for i, probabilities in zip(unnamed, self._classes(frame, plane, masks, geometry)[0]):
                named = _classified(detections[i].mask, probabilities)
                result[i] = replace(
                    named, instance_id=detections[i].instance_id, support=detections[i].support
                )
        blind = [i for i in usable if not result[i].yaw_probabilities.size and self._may_be_mug(result[i])]
        crops = [crop(frame, result[i].mask, plane, geometry) for i in blind]
        for i, yaw in zip(blind, self._directions(self.yaw_network, crops, plane)):
            result[i] = replace(result[i], yaw_probabilities=yaw)
        return result

    def posed(
        self, frame: RgbdFrame, plane: SupportPlane, detections: Sequence[ObjectDetection]
    ) -> list[ObjectDetection]:
        """Return the detections, in their order, with probabilities of classes in all resting poses.

        What may lie also gets those of the direction of its axis.

        Detections whose mask contains no depth stay as they are.

        Args:
            frame: RGB-D image.
            plane: What the objects rest on, in the world frame.
            detections: Detections of any source.
        """
        geometry = frame_geometry(frame, plane)
        usable = [i for i, d in enumerate(detections) if geometry.has_depth(d.mask)]
        crops = [crop(frame, detections[i].mask, plane, geometry) for i in usable]
        result = list(detections)
        poses = self.pose_network(*stack_crops(crops))
        lying = [k for k, p in enumerate(poses) if pose_mass(p, "lying") >= self.config.min_lying]
        axes = dict(zip(lying, self._directions(self.axis_network, [crops[k] for k in lying], plane)))
        for k, i in enumerate(usable):
            axis = axes.get(k, np.zeros(0))
            result[i] = replace(detections[i], pose_probabilities=poses[k], axis_probabilities=axis)
        return result

    def _may_be_mug(self, detection: ObjectDetection) -> bool:
        p = detection.class_probabilities
        return detection.category == "mug" or bool(p.size and p[_MUG] >= self.config.min_mug)

    def _classes(
        self,
        frame: RgbdFrame,
        plane: SupportPlane,
        masks: Sequence[Bool[np.ndarray, "h w"]],
        geometry: FrameGeometry,
    ) -> tuple[Float[np.ndarray, "n 5"], list[Crop | None]]:
        """Return class probabilities, and the crop of each mask that is its own core, None for the others."""
        cores = [inner if geometry.has_depth(inner := mask_core(mask)) else mask for mask in masks]
        crops = [crop(frame, inner, plane, geometry) for inner in cores]
        classes = self.class_network(*stack_crops(crops))
        return classes, [c if core is mask else None for c, core, mask in zip(crops, cores, masks)]

    def _directions(
        self, network: CropPredictor, crops: Sequence[Crop], plane: SupportPlane
    ) -> list[Float[np.ndarray, "b"]]:
        """Return world distributions of a network; the crops are of whole masks: a core has no handle."""
        found = network(*stack_crops(crops)) if crops else []
        return [rotate_yaw(p, heading_angle(c.heading, plane)) for p, c in zip(found, crops)]


def _classified(
    mask: Bool[np.ndarray, "h w"],
    probabilities: Float[np.ndarray, "5"],
    yaw: Float[np.ndarray, "b"] | None = None,
) -> ObjectDetection:
    """Return the detection of the most probable class, which is not 'other'."""
    best = int(probabilities[:OTHER].argmax())
    return ObjectDetection(
        category=CATEGORIES[best],
        score=float(probabilities[best]),
        mask=mask,
        class_probabilities=probabilities,
        yaw_probabilities=np.zeros(0) if yaw is None else yaw,
    )


def _is_part(mask: Bool[np.ndarray, "h w"], things: Sequence[np.ndarray], frame: RgbdFrame) -> bool:
    return any(continued_share(mask, thing, frame.depth) >= SHARE for thing in things)


def combine_probabilities(
    crop_probabilities: Float[np.ndarray, "n 5"], scene_log_classes: Float[np.ndarray, "n 5"]
) -> Float[np.ndarray, "n 5"]:
    """Return the normalised, weighted geometric mean of the probabilities of class and scene network.

    Probabilities of the class network are at least 1e-5, so that it cannot rule out a class alone.
    """
    log = np.log(np.clip(crop_probabilities, 1e-5, 1.0))
    scene = log_softmax(scene_log_classes, axis=1)
    return softmax((1 - SCENE_SHARE) * log + SCENE_SHARE * scene, axis=1)
