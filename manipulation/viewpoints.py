"""Looking: wrist-camera viewpoints around a spot, postures that reach them, and the images taken there."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from manipulation.collision import CollisionWorld
from manipulation.errors import PlanningError
from manipulation.kinematics import Kinematics
from manipulation.motions import Motions
from manipulation.obstacles import TABLE, Furniture
from manipulation.robot import Robot
from manipulation.trajectories import MotionConfig
from perception.types import RgbdFrame

_log = logging.getLogger(__name__)

ROLLS = np.deg2rad(np.arange(0, 360, 45))  # of the camera about its optical axis; all see the same
MIN_LIMIT_DISTANCE = 0.1  # [rad] that each joint keeps from its limits
# Where anything may stand counts as filled while the arm only looks: objects on one side, box or line on the
# other. Higher than most objects, lower than every view.
FILLED = (
    Furniture("objects", (0.46, -0.275, 0.14), (0.20, 0.27, 0.14)),
    Furniture("goal", (0.32, 0.37, 0.14), (0.42, 0.24, 0.14)),
)
MARGINS = (0.03, 0.004)  # [m] kept on the way, less only where no way allows more
VIA_HEIGHTS = (0.45, 0.55)  # [m] of the TCP, over which a blocked move is led


@dataclass(frozen=True)
class Viewpoint:
    """Where the camera stands, relative to the spot it looks at.

    Attributes:
        target: (x, y, z) of the spot in [m], world frame.
        azimuth: direction from the spot to the camera about world z in [rad].
        elevation: of that direction above the horizon in [rad].
        distance: from the spot in [m].
    """

    target: tuple[float, float, float]
    azimuth: float
    elevation: float
    distance: float

    def camera_pose(self, roll: float = 0.0) -> Float[np.ndarray, "4 4"]:
        """T_world_camera; at roll 0 the image's x is horizontal."""
        level, up = np.cos(self.elevation), np.sin(self.elevation)
        outward = np.array([level * np.cos(self.azimuth), level * np.sin(self.azimuth), up])
        x = np.array([-np.sin(self.azimuth), np.cos(self.azimuth), 0.0])
        y = np.cross(-outward, x)
        turned = np.cos(roll) * x + np.sin(roll) * y
        T = np.eye(4)
        T[:3, :3] = np.stack([turned, np.cross(-outward, turned), -outward], axis=1)
        T[:3, 3] = np.asarray(self.target) + self.distance * outward
        return T


def around(
    target: tuple[float, float, float], places_deg: Sequence[tuple[float, float, float]]
) -> tuple[Viewpoint, ...]:
    """Viewpoints on one spot from (azimuth [deg], elevation [deg], distance [m])."""
    return tuple(Viewpoint(target, np.deg2rad(a), np.deg2rad(e), d) for a, e, d in places_deg)


# The objects lie at negative y, box and line at positive y; from the base's side the arm cannot look back.
SCAN_VIEWS = around(
    (0.47, -0.26, 0.05),
    [(90, 89, 0.62), (60, 60, 0.57), (110, 50, 0.60), (210, 50, 0.60), (250, 62, 0.58), (330, 75, 0.52)],
)
BOX_VIEWS = around((0.50, 0.27, 0.06), [(270, 89, 0.55), (300, 62, 0.55), (240, 55, 0.58)])
LINE_VIEWS = (
    *around((0.50, 0.24, 0.06), [(270, 80, 0.55), (300, 55, 0.55)]),
    *around((0.15, 0.43, 0.06), [(270, 75, 0.50), (300, 60, 0.50)]),
)


def close_views(spot: tuple[float, float, float]) -> tuple[Viewpoint, ...]:
    """Two views on one object, from above and from a reachable side."""
    side = -1.0 if spot[1] > 0 else 1.0
    return around(spot, [(side * 90, 80, 0.45), (side * 70, 58, 0.50)])


def posture_for(
    kinematics: Kinematics, view: Viewpoint, q_near: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"] | None:
    """The posture nearest to ``q_near`` [rad] that brings the camera to the viewpoint, over its rolls."""
    found = []
    for roll in ROLLS:
        T_world_camera = view.camera_pose(roll)
        result = kinematics.inverse(
            T_world_camera, [q_near, kinematics.arm.q_home], frame="camera", name="view"
        )
        if result.converged and kinematics.limit_distance(result.q) > MIN_LIMIT_DISTANCE:
            found.append(result.q)
    return min(found, key=lambda q: float(np.abs(q - q_near).max()), default=None)


def look(
    robot: Robot,
    kinematics: Kinematics,
    views: Sequence[Viewpoint],
    progress: Callable[[int, int], None] = lambda done, total: None,
    motion: MotionConfig | None = None,
    on_frame: Callable[[RgbdFrame], None] = lambda frame: None,
) -> list[RgbdFrame]:
    """Move the wrist camera to each viewpoint and take an image there; unreachable ones are passed over.

    The moves stay out of the space where objects may be, known or not; only a first move that starts inside
    it (above an object that was let go) leaves it the straight way.

    Raises:
        PlanningError: no viewpoint can be reached.
    """
    world = CollisionWorld(robot.arm, [], (TABLE, *FILLED))
    motions = Motions(kinematics, world, motion or MotionConfig(), VIA_HEIGHTS)
    width = robot.gripper_width()
    frames: list[RgbdFrame] = []
    for index, view in enumerate(views):
        q_now = robot.joint_positions()
        q = posture_for(kinematics, view, q_now)
        way = None if q is None else motions.free_way(q_now, q, width, MARGINS)
        if way is None and q is not None and world.contact(q_now, width) is not None:
            way = [q_now, q]
        if way is None:
            _log.warning("viewpoint %d of %d cannot be reached and is left out", index + 1, len(views))
            continue
        robot.follow(motions.timed_way(way))
        frames.append(robot.capture())
        on_frame(frames[-1])
        progress(index + 1, len(views))
    if not frames:
        raise PlanningError(f"none of {len(views)} viewpoints can be reached: look at a nearer spot")
    return frames
