"""What manipulation plans with: standing objects, grasps, placements, plans, outcomes; all frozen.

Every object is handled in its *stand frame*: origin on the support below the axis of its body, z up, x
towards the handle of a mug or along the narrow side of a flat bottle. It keeps the tilt and the hover of a
fitted pose out of the plan: the object was standing when it was seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from manipulation.robot import JointTrajectory
from perception.types import Category

Task = Literal["pack", "sort"]
GraspKind = Literal["rim", "top"]


@dataclass(frozen=True)
class Box:
    """An open upright box standing on the table.

    Attributes:
        center: (x, y) of its middle in [m], world frame.
        size: inner length (x), width (y) and depth (z) in [m].
        floor: height of its floor above the table in [m].
        wall: thickness of the walls in [m].
    """

    center: tuple[float, float] = (0.50, 0.27)
    size: tuple[float, float, float] = (0.34, 0.30, 0.08)
    floor: float = 0.004
    wall: float = 0.008

    @property
    def top(self) -> float:
        """Height of its walls above the table in [m]."""
        return self.floor + self.size[2]


@dataclass(frozen=True)
class Line:
    """Where sorted objects stand: from ``start`` towards ``end``, (x, y) in [m], world frame."""

    start: tuple[float, float] = (0.66, 0.16)
    end: tuple[float, float] = (-0.10, 0.56)

    @property
    def length(self) -> float:
        return float(np.hypot(self.end[0] - self.start[0], self.end[1] - self.start[1]))

    @property
    def direction(self) -> Float[np.ndarray, "2"]:
        return (np.array(self.end) - np.array(self.start)) / self.length


@dataclass(frozen=True)
class StandingObject:
    """A perceived object as manipulation sees it.

    Attributes:
        id, name, category: as in the object map.
        vertices: (v, 3) of its mesh in the stand frame in [m].
        faces: (f, 3).
        T_world_stand: (4, 4) where it stands.
        size: what sorting compares, in [m].
        is_round: whether every upright axis section is alike, so that yaw does not matter.
    """

    id: int
    name: str
    category: Category
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    T_world_stand: Float[np.ndarray, "4 4"]
    size: float
    is_round: bool

    @property
    def top(self) -> float:
        """Height of the highest point above the support in [m]."""
        return float(self.vertices[:, 2].max())


@dataclass(frozen=True)
class Grasp:
    """One way to hold an object.

    Attributes:
        kind: over the rim of a hollow object, or around a body or neck from above.
        T_stand_tcp: (4, 4) TCP pose in the object's stand frame.
        away: (3,) unit vector in the stand frame along which the hand leaves, and, reversed, comes.
        opening: width between the pads before closing in [m].
        held_width: expected between the pads while they hold, in [m].
        closed_width: smallest and largest width between the pads that means that something is held, in [m].
            Generous: shapes are estimates, and fingers that stop well inside their opening hold something.
        release_opening: the least width that lets go of the object, in [m].
        depth: how far the TCP is below the top of the object in [m].
        azimuth: direction of the grasp about the stand frame's z in [rad].
        score: preference before the arm and the neighbours are considered; higher is better.
    """

    kind: GraspKind
    T_stand_tcp: Float[np.ndarray, "4 4"]
    away: Float[np.ndarray, "3"]
    opening: float
    held_width: float
    closed_width: tuple[float, float]
    release_opening: float
    depth: float
    azimuth: float
    score: float


@dataclass(frozen=True)
class Placement:
    """Where an object shall stand.

    Attributes:
        name: of the object.
        position: (x, y, z) of the stand frame's origin in [m], world frame, before anything it nests in.
        yaws: admissible directions of the stand frame's x in [rad], the preferred one first.
        stack: names of the objects below it in a nest, lowest first; empty on the floor.
        release_height: how far above its resting place the object is let go, in [m].
    """

    name: str
    position: tuple[float, float, float]
    yaws: tuple[float, ...]
    stack: tuple[str, ...] = ()
    release_height: float = 0.003


@dataclass(frozen=True)
class TaskPlan:
    """The whole task before the first motion: what goes where, and in which order.

    Attributes:
        task: "pack" or "sort".
        objects: everything perceived, by name; what is not placed is an obstacle.
        placements: in the order of execution.
        left_out: name and reason of each object that the plan does not place.
        box: the box of a packing task.
        line: the line of a sorting task.
    """

    task: Task
    objects: Mapping[str, StandingObject]
    placements: tuple[Placement, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)
    box: Box | None = None
    line: Line | None = None


@dataclass(frozen=True)
class PickPlacePlan:
    """All motions for one object; the gripper opens before ``approach`` and acts between the motions.

    Attributes:
        name: of the object.
        grasp, placement: the pair that was chosen.
        T_world_stand_goal: (4, 4) where the object is let go.
        T_world_stand_rest: (4, 4) where it then rests.
        release_opening: width between the pads that lets go of it there, in [m].
        approach: from the start posture to the grasp.
        lift: from the grasp up.
        transfer: from there to above the goal and down to it.
        settle: a little further down with the pads loose, so that a lip on a pad comes free; None for none.
        retreat: from there up, without the object.
    """

    name: str
    grasp: Grasp
    placement: Placement
    T_world_stand_goal: Float[np.ndarray, "4 4"]
    T_world_stand_rest: Float[np.ndarray, "4 4"]
    release_opening: float
    approach: JointTrajectory
    lift: JointTrajectory
    transfer: JointTrajectory
    settle: JointTrajectory | None
    retreat: JointTrajectory

    @property
    def duration(self) -> float:
        """Of the motions together, in [s]."""
        parts = (self.approach, self.lift, self.transfer, self.settle, self.retreat)
        return sum(part.duration for part in parts if part is not None)


@dataclass(frozen=True)
class ObjectOutcome:
    """What became of one object.

    Attributes:
        id, name: of the object.
        placed: whether it was let go at its goal.
        attempts: grasps tried.
        reason: why it was not placed; empty if it was.
        T_world_stand: (4, 4) where it should now rest, or None if it was not placed.
    """

    id: int
    name: str
    placed: bool
    attempts: int
    reason: str = ""
    T_world_stand: Float[np.ndarray, "4 4"] | None = None
