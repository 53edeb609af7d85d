"""The part of the table that a task uses: the standard cell, scaled to the arm's reach.

A cell of scale s is geometrically similar to the standard one: places, viewpoints, keep-out volumes and
heights of motions are s times as far from the foot of the arm's first axis. Images of it look the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from manipulation.collision import CollisionWorld
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE, Obstacle
from manipulation.robot import ArmDescription
from manipulation.viewpoints import (
    BOX_VIEWPOINTS,
    KEEP_OUT,
    LINE_VIEWPOINTS,
    VIA_HEIGHTS,
    Viewpoint,
    closeup_viewpoints,
    further_viewpoints,
    scan_viewpoints,
)

if TYPE_CHECKING:
    from manipulation.planner import ManipulationConfig

SCALES = tuple(round(1.0 - 0.05 * step, 2) for step in range(15))  # tried in order, 1.0 to 0.3
ENOUGH = 0.95  # share of the sampled places in reach from which a scale suits an arm
# Corners and middle of the areas of objects and box [m], and heights of the tool frame there: at the wall of
# a low object, and of an object carried over the wall of the box.
PLACES = (
    (0.32, -0.08), (0.32, -0.46), (0.46, -0.27), (0.60, -0.08), (0.58, -0.38),
    (0.38, 0.17), (0.38, 0.37), (0.50, 0.27), (0.62, 0.17), (0.60, 0.36),
)  # fmt: skip
HEIGHTS = (0.04, 0.30)
TURNS = (0.0, np.pi / 2)  # of the hand about the vertical, relative to its yaw at home
_SEEDS = 3
_FITS: dict[tuple, ReachFit] = {}  # that of the last arm asked for


@dataclass(frozen=True)
class Workspace:
    """Viewpoints, keep-out volumes and heights of motions in a cell of some scale.

    Attributes:
        scale: lengths relative to the standard cell.
    """

    scale: float = 1.0

    def scan_viewpoints(self, count: int = 6) -> tuple[Viewpoint, ...]:
        """Return the ``count`` most informative viewpoints on the area of the objects."""
        return tuple(self._scaled(viewpoint) for viewpoint in scan_viewpoints(count))

    def further_viewpoints(self, count: int) -> tuple[Viewpoint, ...]:
        """Return the viewpoints that ``scan_viewpoints(count)`` lacks, the most informative first."""
        return tuple(self._scaled(viewpoint) for viewpoint in further_viewpoints(count))

    @property
    def box_viewpoints(self) -> tuple[Viewpoint, ...]:
        """Viewpoints on the box."""
        return tuple(map(self._scaled, BOX_VIEWPOINTS))

    @property
    def line_viewpoints(self) -> tuple[Viewpoint, ...]:
        """Viewpoints on the sorting line."""
        return tuple(map(self._scaled, LINE_VIEWPOINTS))

    def closeup_viewpoints(self, x: float, y: float) -> tuple[Viewpoint, ...]:
        """Return viewpoints on one object at (x, y) [m]."""
        viewpoints = closeup_viewpoints((x, y, 0.05 * self.scale))
        return tuple(replace(viewpoint, distance=self.scale * viewpoint.distance) for viewpoint in viewpoints)

    @property
    def keep_out(self) -> tuple[Obstacle, ...]:
        """Keep-out volumes of the camera motions."""
        return tuple(
            replace(volume, center=self._lengths(volume.center), half_size=self._lengths(volume.half_size))
            for volume in KEEP_OUT
        )

    @property
    def via_heights(self) -> tuple[float, ...]:
        """Heights [m] of the TCP at the waypoints of a blocked camera motion."""
        return self._lengths(VIA_HEIGHTS)

    def adapted(self, config: ManipulationConfig) -> ManipulationConfig:
        """Return settings of manipulation with heights and radius of motions and ``free_area`` scaled."""
        pick_place = config.pick_place
        segments = replace(
            pick_place.segments,
            lift=replace(pick_place.segments.lift, heights=self._lengths(pick_place.segments.lift.heights)),
            raise_heights=self._lengths(pick_place.segments.raise_heights),
        )
        pick_place = replace(
            pick_place,
            segments=segments,
            via_heights=self._lengths(pick_place.via_heights),
            middle_radius=self.scale * pick_place.middle_radius,
        )
        x, y = config.free_area
        return replace(config, pick_place=pick_place, free_area=(self._lengths(x), self._lengths(y)))

    def _scaled(self, viewpoint: Viewpoint) -> Viewpoint:
        return replace(
            viewpoint, target=self._lengths(viewpoint.target), distance=self.scale * viewpoint.distance
        )

    def _lengths(self, lengths: tuple[float, ...]) -> tuple:
        return tuple(self.scale * length for length in lengths)


@dataclass(frozen=True)
class ReachFit:
    """The workspace that suits an arm.

    Attributes:
        workspace: the largest one of which the arm reaches ENOUGH; else the one of which it reaches most.
        share: share of its sampled places that the arm reaches with its hand pointing down.
    """

    workspace: Workspace
    share: float


def arm_workspace(arm: ArmDescription) -> ReachFit:
    """Return ``fit_workspace`` of an arm with its home posture; computed once per arm."""
    key = (arm.mjcf, arm.joint_names, arm.tcp_site, arm.max_width, tuple(map(float, arm.q_home)))
    if key not in _FITS:
        _FITS.clear()
        _FITS[key] = fit_workspace(Kinematics(arm))
    return _FITS[key]


def fit_workspace(kinematics: Kinematics, lift: float = 0.0) -> ReachFit:
    """Return the workspace that suits an arm's reach.

    Args:
        kinematics: the arm.
        lift: height [m] by which the arm's base is supposed to be raised.
    """
    best = ReachFit(Workspace(SCALES[0]), -1.0)
    for scale in SCALES:
        share = reachable_share(kinematics, scale, lift)
        if share >= ENOUGH:
            return ReachFit(Workspace(scale), share)
        if share > best.share + 1e-9:
            best = ReachFit(Workspace(scale), share)
    return best


def reachable_share(kinematics: Kinematics, scale: float, lift: float = 0.0) -> float:
    """Return the share of the sampled places of a scaled cell that a hand pointing down reaches freely."""
    x, y, z = TABLE.center
    table = replace(TABLE, center=(x, y, z - lift))
    world = CollisionWorld(kinematics.arm, [], (table,))
    poses = place_poses(kinematics, scale, lift)
    return float(np.mean([_is_reached(kinematics, world, T) for T in poses]))


def _is_reached(kinematics: Kinematics, world: CollisionWorld, T: Float[np.ndarray, "4 4"]) -> bool:
    """Return whether some posture brings the tool frame to a pose, free of collisions with table and arm."""
    for seed in kinematics.seeds_toward(T, _SEEDS):
        result = kinematics.inverse(T, [seed], name="a place")
        if result.converged and world.contact(result.q, kinematics.arm.max_width) is None:
            return True
    return False


def place_poses(kinematics: Kinematics, scale: float, lift: float = 0.0) -> list[Float[np.ndarray, "4 4"]]:
    """Return the sampled poses of the tool frame: vertical, turned with the arm's bearing.

    An arm that is to be raised by ``lift`` [m] sees the table that much lower.
    """
    yaw = hand_yaw(kinematics)
    poses = []
    for x, y in PLACES:
        for height in HEIGHTS:
            for turn in TURNS:
                angle = yaw + np.arctan2(y, x) + turn
                poses.append(hand_down((scale * x, scale * y, scale * height - lift), angle))
    return poses


def hand_yaw(kinematics: Kinematics) -> float:
    """Return the yaw [rad] of the hand at home, relative to its direction from the base."""
    T_home = kinematics.forward(np.asarray(kinematics.arm.q_home, dtype=np.float64))
    return float(np.arctan2(T_home[1, 0], T_home[0, 0])) - kinematics.bearing(T_home)


def hand_down(position: Sequence[float], yaw: float) -> Float[np.ndarray, "4 4"]:
    """Return ``T_world_tcp`` of a hand at a position [m] that points down, turned by ``yaw`` [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    T = np.eye(4)
    T[:3, :3] = [[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]]
    T[:3, 3] = position
    return T
