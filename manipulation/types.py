"""Data types of manipulation planning: standing objects, grasps, placements, plans and outcomes; all frozen.

An object's *stand frame* has its origin on the support below the axis of its body, z up and x towards the
handle of a mug or along the narrow side of a flat bottle. Tilt and height errors of the estimated pose
therefore do not enter the plan.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from manipulation.robot import JointTrajectory
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import Category

Task = Literal["pack", "sort"]
GraspKind = Literal["rim", "top", "waist", "antipodal"]


@dataclass(frozen=True)
class Rejected:
    """A candidate that a search discarded.

    Attributes:
        reason: short phrase that fits behind a count, such as "out of reach".
        blocker: name of the object or thing that is in the way; empty if none is.
        by_arm: whether a link before the hand meets something or a joint reaches its limit, so that another
            posture with the same pose of the hand may be free.
    """

    reason: str
    blocker: str = field(default="", compare=False)
    by_arm: bool = field(default=False, compare=False)


@dataclass(frozen=True)
class Box:
    """An open upright box standing on the table.

    Attributes:
        center: (x, y) of its centre in [m], world frame.
        size: inner length (x), width (y) and depth (z) in [m].
        floor: height of its inner floor above the table in [m].
        wall: thickness of the walls in [m].
    """

    center: tuple[float, float] = (0.50, 0.27)
    size: tuple[float, float, float] = (0.34, 0.30, 0.08)
    floor: float = 0.004
    wall: float = 0.008

    @property
    def top(self) -> float:
        """Height of the upper edge of its walls above the table in [m]."""
        return self.floor + self.size[2]

    def contains(self, T_world: Float[np.ndarray, "4 4"]) -> bool:
        """Return whether the origin of a pose is between its walls as seen from above."""
        return bool((2 * np.abs(T_world[:2, 3] - self.center) < self.size[:2]).all())


@dataclass(frozen=True)
class Line:
    """Line segment on the table along which objects are sorted.

    Attributes:
        start, end: (x, y) of its end points in [m], world frame.
    """

    start: tuple[float, float] = (0.66, 0.16)
    end: tuple[float, float] = (-0.10, 0.56)

    def scaled(self, scale: float) -> Line:
        """Return the line of a similar cell."""
        return Line(
            (scale * self.start[0], scale * self.start[1]), (scale * self.end[0], scale * self.end[1])
        )

    @property
    def length(self) -> float:
        """Length in [m]."""
        return float(np.hypot(self.end[0] - self.start[0], self.end[1] - self.start[1]))

    @property
    def direction(self) -> Float[np.ndarray, "2"]:
        """Unit vector from start to end."""
        return (np.array(self.end) - np.array(self.start)) / self.length

    def position(self, point: Float[np.ndarray, "2"]) -> tuple[float, float]:
        """Return the position of a point (x, y) along the line, and its distance from the segment, in [m]."""
        offset = np.asarray(point) - np.array(self.start)
        along = float(offset @ self.direction)
        nearest = np.clip(along, 0.0, self.length) * self.direction
        return along, float(np.linalg.norm(offset - nearest))


@dataclass(frozen=True)
class StandingObject:
    """A perceived object with its mesh in the stand frame.

    Attributes:
        id, name, category: those of the object map.
        vertices: (v, 3) of its mesh in the stand frame in [m].
        faces: (f, 3) vertex indices of its triangles.
        T_world_stand: (4, 4) pose of the stand frame.
        size: length that sorting compares, in [m].
        is_round: whether the body is rotationally symmetric, so that its yaw is arbitrary.
        sigma: (v,) standard deviation of its vertices along their normals in [m]; empty if they are exact.
    """

    id: int
    name: str
    category: Category
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    T_world_stand: Float[np.ndarray, "4 4"]
    size: float
    is_round: bool
    sigma: Float[np.ndarray, "_v"] = field(default_factory=lambda: np.zeros(0))

    @property
    def top(self) -> float:
        """Height of the highest point above the support in [m]."""
        return float(self.vertices[:, 2].max())


@dataclass(frozen=True)
class Grasp:
    """A parallel-jaw grasp of one object.

    Attributes:
        kind: "rim" of a hollow object, "top": around a body or neck from above, "waist": across the axis of a
            lying object, or "antipodal": between opposite points of an object in any orientation.
        T_stand_tcp: (4, 4) TCP pose in the object's stand frame while the hand holds it.
        away: (3,) unit vector of the retreat in the stand frame; the approach is its opposite.
        opening: width between the pads before closing in [m].
        held_width: expected width between the pads while they hold the object, in [m].
        closed_width: smallest and largest width between the pads in [m] that count as holding the object; a
            wide range, because shapes are estimates.
        release_opening: smallest width between the pads that releases the object, in [m].
        depth: distance of the TCP below the top of the object in [m].
        azimuth: direction of the grasp about the stand frame's z in [rad].
        score: preference from the object's shape alone; higher is better.
        stand_off: distance in [m] of the fixed pad from the object before one moving jaw closes; the TCP is
            that far along -y from where it is in the end.
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
    stand_off: float = 0.0

    @property
    def T_stand_open(self) -> Float[np.ndarray, "4 4"]:
        """TCP pose in the object's stand frame before the hand closes."""
        T = self.T_stand_tcp.copy()
        T[:3, 3] -= self.stand_off * T[:3, 1]
        return T

    def held_at(self, T_stand_tcp: Float[np.ndarray, "4 4"]) -> Grasp:
        """Return the grasp of an object that has shifted in the hand, which retreats as before."""
        turn = T_stand_tcp[:3, :3] @ self.T_stand_tcp[:3, :3].T
        return replace(self, T_stand_tcp=T_stand_tcp, away=turn @ self.away)


RIMMED: tuple[Category, ...] = ("mug", "bowl")  # classes that are grasped at their rims
TOO_WIDE = "too wide"  # how the reasons of grasps that exceed the opening begin


@dataclass(frozen=True)
class GraspSet:
    """Grasp candidates of one object.

    Attributes:
        grasps: in descending order of score.
        rejected: number of discarded candidates by reason.
    """

    grasps: tuple[Grasp, ...]
    rejected: Counter[str]

    @property
    def n_candidates(self) -> int:
        """Number of accepted and discarded candidates."""
        return len(self.grasps) + sum(self.rejected.values())

    def failure_message(self, name: str, remedy: str = "") -> str:
        """Return the error message for an object without a grasp: counts by reason and a remedy."""
        counts = ", ".join(f"{count} {reason}" for reason, count in self.rejected.most_common(4))
        too_wide = any(reason.startswith(TOO_WIDE) for reason, _ in self.rejected.most_common(1))
        remedy = remedy or ("exclude it or use a wider gripper" if too_wide else "exclude it")
        return f"No grasp for {name}: of {self.n_candidates} candidates, {counts}; {remedy}"


@dataclass(frozen=True)
class Placement:
    """Goal of one object.

    Attributes:
        name: of the object.
        position: (x, y, z) of the stand frame's origin in [m], world frame; of the lowest object of a stack.
        yaws: admissible directions of the stand frame's x in [rad], the preferred one first.
        stack: names of the bowls below it in its stack, lowest first; empty on the floor.
        release_height: height above its resting pose at which the object is released, in [m].
        T_goal_stand: (4, 4) pose of the stand frame relative to position and yaw, of an object that is laid
            on its side; None if it is to stand.
    """

    name: str
    position: tuple[float, float, float]
    yaws: tuple[float, ...]
    stack: tuple[str, ...] = ()
    release_height: float = 0.003
    T_goal_stand: Float[np.ndarray, "4 4"] | None = None


@dataclass(frozen=True)
class TaskPlan:
    """Goals of all objects of a task in the order of execution.

    Attributes:
        task: "pack" or "sort".
        objects: all perceived objects by name; those without a placement are obstacles.
        placements: goals in the order of execution.
        left_out: name and reason of each object without a placement.
        box: the box of a packing task.
        lines: rows of a sorting task in the order of sizes.
        grasps: grasp candidates by name of the object; execution generates those that are missing.
        obstacles: things of no class, which nothing may touch.
    """

    task: Task
    objects: Mapping[str, StandingObject]
    placements: tuple[Placement, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)
    box: Box | None = None
    lines: tuple[Line, ...] = ()
    grasps: Mapping[str, GraspSet] = field(default_factory=dict)
    obstacles: tuple[PerceivedObstacle, ...] = ()


@dataclass(frozen=True)
class PickPlacePlan:
    """All motions for one object; the gripper opens before ``approach`` and moves between the motions.

    Attributes:
        name: of the object.
        grasp, placement: chosen grasp and goal.
        T_world_stand_goal: (4, 4) pose of the stand frame when the object is released.
        T_world_stand_rest: (4, 4) pose at which it then rests.
        release_opening: width between the pads that releases it, in [m].
        transit: motion from the start posture to a posture above the grasp, from which the object is seen;
            None if there is none.
        approach: straight motion from there to the grasp.
        lift: vertical motion from the grasp.
        carry: motion from there to a point above the goal.
        lowering: straight motion from there down to the goal.
        settle: short descent with loosened pads, so that a lip or cap comes off a pad; None if not needed.
        retreat: motion away from the released object.
        contents: names of what stays in the object while it is carried.
    """

    name: str
    grasp: Grasp
    placement: Placement
    T_world_stand_goal: Float[np.ndarray, "4 4"]
    T_world_stand_rest: Float[np.ndarray, "4 4"]
    release_opening: float
    transit: JointTrajectory | None
    approach: JointTrajectory
    lift: JointTrajectory
    carry: JointTrajectory
    lowering: JointTrajectory
    settle: JointTrajectory | None
    retreat: JointTrajectory
    contents: tuple[str, ...] = ()

    @property
    def duration(self) -> float:
        """Total duration of the motions in [s]."""
        parts = (self.transit, self.approach, self.lift, self.carry, self.lowering, self.settle, self.retreat)
        return sum(part.duration for part in parts if part is not None)

    def poses_after(
        self, poses: Mapping[str, Float[np.ndarray, "4 4"]]
    ) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Return T_world_stand of the object and of its contents after the plan, by name.

        Args:
            poses: T_world_stand before it.
        """
        moved = self.T_world_stand_rest @ np.linalg.inv(poses[self.name])
        return {self.name: self.T_world_stand_rest} | {name: moved @ poses[name] for name in self.contents}


@dataclass(frozen=True)
class ObjectOutcome:
    """Result of executing one placement.

    Attributes:
        id, name: of the object.
        placed: whether the object was released at its goal.
        attempts: number of executed grasps.
        reason: cause of the failure; empty if placed.
        T_world_stand: (4, 4) resting pose in which it is expected; None if not placed.
        T_world_left: (4, 4) pose in which an object that was not placed was seen last; None if it is unknown.
    """

    id: int
    name: str
    placed: bool
    attempts: int
    reason: str = ""
    T_world_stand: Float[np.ndarray, "4 4"] | None = None
    T_world_left: Float[np.ndarray, "4 4"] | None = None
