"""Wrist-camera viewpoints around a target, inverse kinematics for them, and image capture."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from manipulation.collision import CollisionWorld
from manipulation.errors import PlanningError
from manipulation.kinematics import Kinematics
from manipulation.motions import MotionPlanner
from manipulation.nearest_view import FULL_POSE, nearest_view, view_angle
from manipulation.obstacles import TABLE, Obstacle
from manipulation.robot import ArmDescription, Robot, capture_depth
from manipulation.self_view import SelfView
from manipulation.trajectories import MotionConfig, line_postures
from perception.types import RgbdFrame

logger = logging.getLogger(__name__)

ROLLS = np.deg2rad(np.arange(0, 360, 45))  # of the camera about its optical axis, tried for each viewpoint
MIN_LIMIT_DISTANCE = 0.1  # [rad] of each joint from its limits at a viewpoint
_PATHS = 4  # postures at a viewpoint, free of contacts, to which a path is looked for
_VIEW_SEEDS = 8  # start postures of an approximate view
FEW = 4  # viewpoints below which too little of the table is seen
MAX_TURN = np.deg2rad(40)  # of the direction of an approximate view; beyond it adds little to the others
# Keep-out volumes of the camera motions, over the areas where objects may be, known or unknown: the objects'
# area at negative y, box and line at positive y. 0.28 m high: above most objects, below every viewpoint.
# There is room around the base, where no goals are: the shoulder of many arms is beside their first axis.
KEEP_OUT = (
    Obstacle("objects", (0.46, -0.275, 0.14), (0.20, 0.27, 0.14)),
    Obstacle("goal", (0.47, 0.37, 0.14), (0.27, 0.24, 0.14)),
    Obstacle("goal beside the base", (0.05, 0.43, 0.14), (0.15, 0.18, 0.14)),
)
MARGINS = (
    0.03,
    0.004,
)  # [m] clearances of the arm, in descending order; the first that some path keeps is used
VIA_HEIGHTS = (0.45, 0.55)  # [m] of the TCP at the waypoints of a blocked move


@dataclass(frozen=True)
class Viewpoint:
    """Camera position in spherical coordinates about a target, with the optical axis through the target.

    Attributes:
        target: (x, y, z) in [m], world frame.
        azimuth: direction from the target to the camera about world z in [rad].
        elevation: angle of that direction above the horizontal in [rad].
        distance: distance of the camera from the target in [m].
    """

    target: tuple[float, float, float]
    azimuth: float
    elevation: float
    distance: float

    def camera_pose(self, roll: float = 0.0) -> Float[np.ndarray, "4 4"]:
        """Return ``T_world_camera``, rotated by ``roll`` [rad] about the optical axis.

        At roll 0 the image's x axis is horizontal.
        """
        level, up = np.cos(self.elevation), np.sin(self.elevation)
        outward = np.array([level * np.cos(self.azimuth), level * np.sin(self.azimuth), up])
        x = np.array([-np.sin(self.azimuth), np.cos(self.azimuth), 0.0])
        y = np.cross(-outward, x)
        x_rolled = np.cos(roll) * x + np.sin(roll) * y
        T = np.eye(4)
        T[:3, :3] = np.stack([x_rolled, np.cross(-outward, x_rolled), -outward], axis=1)
        T[:3, 3] = np.asarray(self.target) + self.distance * outward
        return T


def viewpoints_around(
    target: tuple[float, float, float], directions: Sequence[tuple[float, float, float]]
) -> tuple[Viewpoint, ...]:
    """Return viewpoints on one target from (azimuth [deg], elevation [deg], distance [m])."""
    return tuple(Viewpoint(target, np.deg2rad(a), np.deg2rad(e), d) for a, e, d in directions)


# Viewpoints of the standard cell: objects at negative y, box and line at positive y. All look away from the
# base, because the wrist camera cannot be directed back at it within reach.
SCAN_VIEWPOINTS = viewpoints_around(
    (0.47, -0.26, 0.05),
    [(90, 89, 0.62), (60, 60, 0.57), (110, 50, 0.60), (210, 50, 0.60), (250, 62, 0.58), (330, 75, 0.52)],
)
_MOST_INFORMATIVE = (1, 4, 3, 5, 2, 0)  # of them, first: oblique views from opposite sides
BOX_VIEWPOINTS = viewpoints_around((0.50, 0.27, 0.06), [(270, 89, 0.55), (300, 62, 0.55), (240, 55, 0.58)])
LINE_VIEWPOINTS = (
    *viewpoints_around((0.50, 0.24, 0.06), [(270, 80, 0.55), (300, 55, 0.55)]),
    *viewpoints_around((0.15, 0.43, 0.06), [(270, 75, 0.50), (300, 60, 0.50)]),
)


def scan_viewpoints(count: int) -> tuple[Viewpoint, ...]:
    """Return the ``count`` most informative of the SCAN_VIEWPOINTS in their order."""
    return tuple(SCAN_VIEWPOINTS[i] for i in sorted(_MOST_INFORMATIVE[:count]))


def further_viewpoints(count: int) -> tuple[Viewpoint, ...]:
    """Return the SCAN_VIEWPOINTS that ``scan_viewpoints(count)`` lacks, the most informative first."""
    return tuple(SCAN_VIEWPOINTS[i] for i in _MOST_INFORMATIVE[count:])


def closeup_viewpoints(target: tuple[float, float, float]) -> tuple[Viewpoint, ...]:
    """Return two viewpoints on one object: from above and from the side towards y = 0."""
    side = -1.0 if target[1] > 0 else 1.0
    return viewpoints_around(target, [(side * 90, 80, 0.45), (side * 70, 58, 0.50)])


def viewpoint_postures(
    kinematics: Kinematics, viewpoint: Viewpoint, q_near: Float[np.ndarray, "n"]
) -> Iterator[Float[np.ndarray, "n"]]:
    """Yield postures [rad] with the camera at a viewpoint, the preferred ones first.

    At any roll, from ``q_near``, those nearest to it first; then from the home posture, whose elbow may be on
    the other side.

    Arms of fewer than six joints take the posture with the nearest view of the target, others only if
    ``ArmDescription.near_views`` and the viewpoint is out of reach. There are none if the target is out of
    sight or, with six joints or more, seen from another side.
    """
    exact = len(kinematics.lower) >= FULL_POSE
    home = np.asarray(kinematics.arm.q_home, dtype=np.float64)
    is_reached = False
    for seeds in ((q_near, home), (home,)) if exact else ():
        results = (
            kinematics.inverse(viewpoint.camera_pose(roll), seeds, frame="camera", name="a viewpoint")
            for roll in ROLLS
        )
        reached = [
            r.q for r in results if r.converged and kinematics.limit_distance(r.q) > MIN_LIMIT_DISTANCE
        ]
        yield from sorted(reached, key=lambda q: float(np.abs(q - q_near).max()))
        is_reached |= bool(reached)
    if is_reached or (exact and not kinematics.arm.near_views):
        return
    T, target = viewpoint.camera_pose(), np.array(viewpoint.target)
    seeds = [q_near, *kinematics.seeds_toward(T, _VIEW_SEEDS)]
    q = nearest_view(kinematics, target, T[:3, 3], seeds, MIN_LIMIT_DISTANCE)
    if q is not None and not (exact and view_angle(kinematics, q, target, T[:3, 3]) > MAX_TURN):
        yield q


def viewpoint_ik(
    kinematics: Kinematics, viewpoint: Viewpoint, q_near: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"] | None:
    """Return the first of ``viewpoint_postures``; None if there is none."""
    return next(viewpoint_postures(kinematics, viewpoint, q_near), None)


def with_near_views(arm: ArmDescription, viewpoints: Sequence[Viewpoint]) -> ArmDescription:
    """Return the arm; it takes near views if it reaches fewer than FEW of the viewpoints exactly."""
    kinematics = Kinematics(arm)
    q = np.asarray(arm.q_home, dtype=np.float64)
    reached = (viewpoint_ik(kinematics, viewpoint, q) is not None for viewpoint in viewpoints)
    few = len(list(itertools.islice(filter(None, reached), FEW))) < FEW
    return replace(arm, near_views=True) if few else arm


class ViewpointScanner:
    """Moves the wrist camera of a robot to viewpoints and captures images there.

    The motions avoid the keep-out volumes; a first motion that starts inside one of them (above a released
    object) leaves it straight up.

    Args:
        robot: robot with a wrist camera.
        kinematics: kinematics of its arm.
        motion: speed limits.
        keep_out: volumes that the arm must not enter, besides the table.
        via_heights: TCP heights of the waypoints of a blocked move, in [m].
    """

    def __init__(
        self,
        robot: Robot,
        kinematics: Kinematics,
        motion: MotionConfig = MotionConfig(),
        keep_out: Sequence[Obstacle] = KEEP_OUT,
        via_heights: Sequence[float] = VIA_HEIGHTS,
    ) -> None:
        self.robot, self.kinematics = robot, kinematics
        world = CollisionWorld(robot.arm, [], (TABLE, *keep_out))
        self.motions = MotionPlanner(kinematics, world, motion, via_heights)
        self._self_view = SelfView(robot.arm)
        self._visited: dict[Viewpoint, Float[np.ndarray, "n"]] = {}  # postures [rad], to be taken again

    def capture(
        self,
        viewpoints: Sequence[Viewpoint],
        progress: Callable[[int, int], None] = lambda done, total: None,
        on_frame: Callable[[RgbdFrame], None] = lambda frame: None,
        as_before: bool = False,
    ) -> list[RgbdFrame]:
        """Capture an image at each viewpoint that can be reached, without the depth of the arm itself.

        What cannot be reached in its turn is tried again from the last viewpoint.

        Args:
            viewpoints: viewpoints in order.
            progress: receives the number of visited and of all viewpoints.
            on_frame: receives each image.
            as_before: whether each viewpoint is visited in the posture of the last such capture if that can
                be reached, so that their images can be compared pixel by pixel; else in the nearest posture.

        Raises:
            PlanningError: no viewpoint can be reached.
        """
        width = self.robot.gripper_width()
        self._rise(width)
        frames: list[RgbdFrame] = []
        remaining = list(range(len(viewpoints)))
        for _ in range(2):
            missed = []
            for index in remaining:
                path = self._path_to(viewpoints[index], width, as_before)
                if path is None:
                    missed.append(index)
                    continue
                if as_before:
                    self._visited[viewpoints[index]] = path[-1]
                self.robot.follow(self.motions.time_path(path))
                frames.append(self.look())
                on_frame(frames[-1])
                progress(len(frames) + len(missed), len(viewpoints))
            remaining = missed
        for index in remaining:
            logger.warning("viewpoint %d of %d is out of reach and skipped", index + 1, len(viewpoints))
        if not frames:
            raise PlanningError(
                f"none of {len(viewpoints)} viewpoints can be reached: choose a nearer target"
            )
        return frames

    def look(self, color: bool = True) -> RgbdFrame:
        """Return an image from the present posture, without the depth of the arm itself.

        Args:
            color: whether the colour is read; without it, the image may be black.
        """
        frame = self.robot.capture() if color else capture_depth(self.robot)
        q, width = self.robot.joint_positions(), self.robot.gripper_width()
        return self._self_view.without_arm(frame, q, width)

    def _rise(self, width: float) -> None:
        """Move the hand straight up out of a keep-out volume, where it may be among objects."""
        q = self.robot.joint_positions()
        if self.motions.world.contact(q, width) is None:
            return
        for height in self.motions.via_heights:
            T_up = self.kinematics.forward(q)
            T_up[2, 3] = max(height, T_up[2, 3])
            postures = line_postures(self.kinematics, q, T_up, self.motions.config)
            if postures is not None:
                self.robot.follow(self.motions.time_line(postures))
                return

    def _path_to(
        self, viewpoint: Viewpoint, width: float, as_before: bool
    ) -> list[Float[np.ndarray, "n"]] | None:
        """Return waypoints [rad] from the present posture to a viewpoint; None if it cannot be reached."""
        q_now = self.robot.joint_positions()
        if as_before and viewpoint in self._visited:
            path = self.motions.free_path(q_now, self._visited[viewpoint], width, MARGINS)
            if path is not None:
                return path
        world, reached, free = self.motions.world, [], []
        for q in viewpoint_postures(self.kinematics, viewpoint, q_now):
            reached.append(q)
            if world.contact(q, width) is not None:
                continue
            free.append(q)
            path = self.motions.free_path(q_now, q, width, MARGINS)
            if path is not None:
                return path
            if len(free) == _PATHS:
                break
        if not reached or world.contact(q_now, width) is None:
            return None
        return [q_now, (free or reached)[0]]
