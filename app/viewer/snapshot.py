"""The displayed state of a run at one show time, as plain values.

Objects are displayed as the robot estimates them: at their fitted pose, attached to the gripper while they
are carried, and at their release pose afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from perception.types import Category

Status = Literal["fitting", "reconstructed", "next", "held", "placed", "not placed"]
TCP, CAMERA = "tcp", "camera"  # bodies of a recording
TASK_STAGES = {
    "scan": "Scan",
    "detect": "Detect",
    "reconstruct": "Reconstruct",
    "plan": "Plan",
    "execute": "Execute",
    "verify": "Verify",
}
SLAM_STAGES = {"slam": "Tracking and mapping", "lost": "Tracking lost"}
STAGE_TITLES = TASK_STAGES | SLAM_STAGES


@dataclass(frozen=True)
class ObjectState:
    """Estimate of an object at one show time.

    Attributes:
        id, category: Id and class in the object map.
        iteration: Iteration of its fit; None once it is in the object map.
        T_world_object: Estimated pose.
        scale: Metres per canonical unit along the object's axes.
        code: Shape code.
        residual: Mean depth residual of the fit in metres, or None.
        status: Progress of the object in the task.
        reason: Why it is not placed; else empty.
    """

    id: int
    category: Category
    iteration: int | None
    T_world_object: Float[np.ndarray, "4 4"]
    scale: Float[np.ndarray, "3"]
    code: Float[np.ndarray, "16"]
    residual: float | None = None
    status: Status = "fitting"
    reason: str = ""

    @property
    def name(self) -> str:
        return f"{self.category}_{self.id}"


@dataclass(frozen=True)
class ObjectOutcome:
    """Outcome of an object in the report.

    Attributes:
        placed: Whether the success criteria hold.
        error_position: Distance from the planned position in metres, or None.
    """

    placed: bool
    error_position: float | None = None


@dataclass(frozen=True)
class StageSpan:
    """Time span of a stage.

    Attributes:
        name: Name of the stage.
        begin, end: Show times in seconds; ``end`` is None until the stage has ended.
        seconds: Wall time that the stage took, or None.
    """

    name: str
    begin: float
    end: float | None = None
    seconds: float | None = None

    @property
    def title(self) -> str:
        return STAGE_TITLES.get(self.name, self.name.capitalize())


@dataclass(frozen=True)
class Snapshot:
    """Everything that is displayed at one show time.

    Attributes:
        time: Show time in seconds.
        stage: Name of the stage, or empty.
        caption: Description of the current action in one line.
        poses: Position [m] and quaternion wxyz of the recorder's bodies.
        n_frames: Number of images captured so far.
        n_searched: Number of images searched for objects so far.
        objects: Object states by id.
        obstacles: Vertices (k, 3) of the convex pieces of each thing of no class by name, in metres.
        goals: Goal poses T_world_object of the plan by object name, without the objects already placed.
        path: (n, 3) planned path of the tool, or in a SLAM run the camera's path so far, in metres.
        grasps: (k, 4, 4) T_world_tcp of the grasp candidates during the approach, the selected one first.
    """

    time: float = 0.0
    stage: str = ""
    caption: str = ""
    poses: Float[np.ndarray, "b 7"] = field(default_factory=lambda: np.zeros((0, 7)))
    n_frames: int = 0
    n_searched: int = 0
    objects: Mapping[int, ObjectState] = field(default_factory=dict)
    obstacles: Mapping[str, tuple[Float[np.ndarray, "_k 3"], ...]] = field(default_factory=dict)
    goals: Mapping[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    path: Float[np.ndarray, "n 3"] | None = None
    grasps: Float[np.ndarray, "k 4 4"] | None = None

    @property
    def latest_image(self) -> int:
        """Index of the image captured last, or searched last during detection; -1 before the first."""
        return (self.n_searched if self.stage == "detect" else self.n_frames) - 1


def pose_matrix(pose: Float[np.ndarray, "7"]) -> Float[np.ndarray, "4 4"]:
    """Return the transform of a position [m] and a quaternion wxyz."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix()
    T[:3, 3] = pose[:3]
    return T
