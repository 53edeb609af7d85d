"""One moment of a recording as plain values: what the viewer draws.

Objects are shown as the robot believes them: where its fit puts them, in the hand while it carries them, and
then where it let go of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from perception.types import Category

Status = Literal["fitting", "reconstructed", "next", "in the hand", "put down", "left"]
TCP, CAMERA = "tcp", "camera"
STAGE_NAMES = {
    "scan": "Look",
    "detect": "Detect",
    "reconstruct": "Reconstruct",
    "plan": "Plan",
    "execute": "Act",
    "verify": "Verify",
}
MAPPING = {"slam": "Track and map", "lost": "Lost"}  # stages of a camera that moves by itself


@dataclass(frozen=True)
class Believed:
    """An object as the robot believes it.

    Attributes:
        id, category: of the object.
        iteration: of its fit; None once the object map has it.
        T_world_object: where it is believed to be.
        scale, code: of its shape so far.
        residual: mean depth residual of the fit in [m], or None.
        status: what is going on with it.
        reason: why it was left, or empty.
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
class StageSpan:
    """A stage on the time line: show time in [s], and the wall time it took in [s]."""

    name: str
    begin: float
    end: float | None = None
    seconds: float | None = None

    @property
    def title(self) -> str:
        return (STAGE_NAMES | MAPPING).get(self.name, self.name.capitalize())


@dataclass(frozen=True)
class Moment:
    """Everything to be seen at one show time.

    Attributes:
        time: show time in [s].
        stage: name of the stage, or empty.
        caption: what happens, in one line.
        poses: position [m] and wxyz of the recorder's bodies.
        n_frames: images taken so far.
        n_found: images searched so far.
        objects: as believed, by id.
        placements: of the plan, once it is made: name to T_world_stand of the goal.
        path: (n, 3) the tool's way in [m] while it is followed; of a camera that moves by itself, so far.
        grasps: (k, 4, 4) T_world_tcp of the candidates, the chosen one first, until one is taken.
    """

    time: float = 0.0
    stage: str = ""
    caption: str = ""
    poses: Float[np.ndarray, "b 7"] = field(default_factory=lambda: np.zeros((0, 7)))
    n_frames: int = 0
    n_found: int = 0
    objects: Mapping[int, Believed] = field(default_factory=dict)
    placements: Mapping[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    path: Float[np.ndarray, "n 3"] | None = None
    grasps: Float[np.ndarray, "k 4 4"] | None = None
