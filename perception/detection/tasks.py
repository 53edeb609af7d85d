"""What the detection networks predict, and their weights files."""

from __future__ import annotations

from typing import Literal

from perception.detection.yaw import YAW_BINS
from perception.types import CATEGORIES, POSED_CLASSES

Task = Literal["class", "pose", "yaw", "axis"]  # of networks on crops
DIRECTIONS: tuple[Task, ...] = ("yaw", "axis")  # what they predict is a direction in the plane
LABELS: tuple[str, ...] = (*CATEGORIES, "other")
POSE_LABELS: tuple[str, ...] = (*(" ".join(posed) for posed in POSED_CLASSES), "other")
CLASSES = len(LABELS)
OUTPUTS: dict[Task, int] = {
    "class": CLASSES,
    "pose": len(POSE_LABELS),
    "yaw": YAW_BINS,
    "axis": YAW_BINS,
}
ENSEMBLE_SIZE: dict[Task, int] = {"class": 1, "pose": 1, "yaw": 1, "axis": 1}  # networks per task
WEIGHTS_FILES: dict[Task, str] = {
    "class": "detector.safetensors",
    "pose": "pose.safetensors",
    "yaw": "yaw.safetensors",
    "axis": "axis.safetensors",
}
TRAINED_BY: dict[Task, str] = {  # jobs of `nodeslam train`
    "class": "detector",
    "pose": "pose",
    "yaw": "yaw",
    "axis": "axis",
}

SCENE_WEIGHTS_FILE = "scene.safetensors"
VOTE_UNIT = 32.0  # pixels of offset per unit of output
# Of the scene network: foreground of 2 x 2 sub-pixels, classes, offset, log of its standard error.
SCENE_OUTPUTS = 4 + CLASSES + 2 + 1
