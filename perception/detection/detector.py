"""From one RGB-D frame to the objects in it.

The scene network finds the instances and says what it takes them for, the class network looks at the core of
each of them closely, and both words count the same; the yaw network says where the handles of mugs point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.special import log_softmax, softmax

from perception.detection import network as nets
from perception.detection.crops import core, crop, frame_geometry, stacked
from perception.detection.geometry import heading_angle
from perception.detection.instances import InstanceConfig, find_instances
from perception.detection.scene_network import WEIGHTS_FILE, SceneNet, load_scene_network
from perception.detection.yaw import turned
from perception.types import CATEGORIES, ObjectDetection, RgbdFrame, SupportPlane

_MUG = CATEGORIES.index("mug")


@dataclass(frozen=True)
class DetectorConfig:
    """What becomes a detection.

    Attributes:
        instances: how instances are found.
        max_other: an instance whose probability of being of no class is above this is left out. Well over
            one half, so that several views can still vote (``association.associate``); the score of a
            doubtful instance is low all the same.
        min_mug: yaw is estimated from this probability of being a mug on.
    """

    instances: InstanceConfig = field(default_factory=InstanceConfig)
    max_other: float = 0.8
    min_mug: float = 0.05


@dataclass(frozen=True)
class Detector:
    """Finds mugs, bowls, bottles and cans in RGB-D frames. Make one with ``load``."""

    scene_network: SceneNet
    class_network: nets.CropNetwork
    class_temperature: float
    yaw_network: nets.CropNetwork
    yaw_temperature: float
    config: DetectorConfig = DetectorConfig()

    @staticmethod
    def load(
        device: str | torch.device = "cpu",
        directory: Path | None = None,
        config: DetectorConfig = DetectorConfig(),
    ) -> Detector:
        """The detector with the shipped weights, or those in ``directory``.

        Raises:
            PerceptionError: weights are missing or damaged.
        """
        paths = {task: None if directory is None else directory / f for task, f in nets.WEIGHTS_FILES.items()}
        scene = None if directory is None else directory / WEIGHTS_FILE
        return Detector(
            load_scene_network(scene, device),
            *nets.load_network("class", paths["class"], device),
            *nets.load_network("yaw", paths["yaw"], device),
            config,
        )

    def __call__(self, frame: RgbdFrame, plane: SupportPlane) -> list[ObjectDetection]:
        """Objects of the frame, most certain first; instances of no class are left out.

        The score is the calibrated probability of the category. Yaw distributions are over world yaw.
        """
        found = find_instances(frame, plane, self.scene_network, self.config.instances)
        hints = [instance.log_classes for instance in found]
        return self.classify(frame, plane, [instance.mask for instance in found], hints)

    def classify(
        self,
        frame: RgbdFrame,
        plane: SupportPlane,
        masks: Sequence[Bool[np.ndarray, "h w"]],
        hints: Sequence[Float[np.ndarray, "5"]] | None = None,
    ) -> list[ObjectDetection]:
        """What the networks say of instances that somebody else has found, as a call does of its own.

        ``hints`` are log-probabilities of the classes that another network gives for each instance; the mean
        of both is taken.
        """
        geometry = frame_geometry(frame, plane)
        kept = [i for i, mask in enumerate(masks) if geometry.seen(mask)]
        if not kept:
            return []
        masks = [masks[i] for i in kept]
        cores = [inner if geometry.seen(inner := core(mask)) else mask for mask in masks]
        pieces = [crop(frame, inner, plane, geometry) for inner in cores]
        classes = nets.predict(self.class_network, self.class_temperature, *stacked(pieces))
        if hints is not None:
            classes = agreed(classes, np.stack([hints[i] for i in kept]).astype(np.float64))
        # The whole mask for the yaw: its core has no handle.
        mugs = np.flatnonzero(classes[:, _MUG] >= self.config.min_mug).tolist()
        whole = [pieces[i] if cores[i] is masks[i] else crop(frame, masks[i], plane, geometry) for i in mugs]
        yaws = nets.predict(self.yaw_network, self.yaw_temperature, *stacked(whole))
        yaw_of = {
            i: turned(yaw, heading_angle(piece.heading, plane)) for i, yaw, piece in zip(mugs, yaws, whole)
        }
        detections = []
        for i, (mask, probabilities) in enumerate(zip(masks, classes)):
            if probabilities[nets.OTHER] > self.config.max_other:
                continue
            best = int(probabilities[: nets.OTHER].argmax())
            detections.append(
                ObjectDetection(
                    category=CATEGORIES[best],
                    score=float(probabilities[best]),
                    mask=mask,
                    class_probabilities=probabilities,
                    yaw_probabilities=yaw_of.get(i, np.zeros(0)),
                )
            )
        return sorted(detections, key=lambda detection: -detection.score)


def agreed(
    probabilities: Float[np.ndarray, "n 5"], hints: Float[np.ndarray, "n 5"]
) -> Float[np.ndarray, "n 5"]:
    """Probabilities from the mean of two networks' log-probabilities; neither can rule anything out alone."""
    return softmax(0.5 * (np.log(np.clip(probabilities, 1e-5, 1.0)) + log_softmax(hints, axis=1)), axis=1)
