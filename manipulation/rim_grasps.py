"""Grasps at the rim of hollow objects: one finger inside, the hand tilted to the slope of the wall."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from manipulation.cross_sections import CrossSectionCache
from manipulation.grasp_config import GraspConfig, half_turn, tcp_pose
from manipulation.standing import HANDLE_HALF_ANGLE
from manipulation.types import Grasp, Rejected, StandingObject
from perception.mesh_sections import outermost, radial_hits

_PLAN_SAMPLES = 9  # of a wall between the edges of the pads
_MOST_TURNED = float(np.deg2rad(25))  # of a wall's normal: an octagon's is turned by 22.5 degrees
_BENT = 2.0  # score that a grasp loses for each radian by which the wall bends between the pads
_UNEVEN = 0.012  # [m] below a reconstructed rim, from which on the wall is closed and its direction exact
_AZIMUTHS = 2 * np.pi * np.arange(16) / 16  # at which the slope of a round wall is measured


def rim_grasps(
    item: StandingObject, sections: CrossSectionCache, config: GraspConfig, rejected: Counter[str]
) -> list[Grasp]:
    """Return rim grasps over all azimuths; count the reasons of the others in ``rejected``."""
    grasps, slopes = [], _Slopes(item, sections)
    for azimuth in 2 * np.pi * np.arange(config.n_azimuths) / config.n_azimuths:
        wrapped = np.angle(np.exp(1j * azimuth))
        if item.category == "mug" and abs(wrapped) < HANDLE_HALF_ANGLE - np.deg2rad(10):
            rejected["at the handle"] += 1
            continue
        grasp = _rim_grasp(item, sections, slopes, float(wrapped), config)
        if isinstance(grasp, Rejected):
            rejected[grasp.reason] += 1
            continue
        grasps += [grasp, half_turn(grasp)]
    return grasps


@dataclass(frozen=True)
class Wall:
    """Cross-section of a wall with a vertical half plane at one height.

    Attributes:
        inner, outer: distances of its sides from the axis in [m].
        across: distance in [m] from the inner side over the cavity to the opposite wall.
        hollow: whether the mesh has a cavity; if not, the thickness is assumed.
    """

    inner: float
    outer: float
    across: float
    hollow: bool = True

    @property
    def middle(self) -> float:
        """Distance of the wall's middle from the axis in [m]."""
        return 0.5 * (self.inner + self.outer)

    @property
    def thickness(self) -> float:
        """Thickness in [m]."""
        return self.outer - self.inner


def wall_at(sections: CrossSectionCache, z: float, azimuth: float, config: GraspConfig) -> Wall | None:
    """Return the wall at height ``z`` [m] and ``azimuth`` [rad]; None where there is none or it is too thick.

    Where the mesh has no cavity, the default thickness is assumed.
    """
    segments = sections.at(z)
    azimuth += 0.003  # offset from round angles, where meshes often have edges
    hits = radial_hits(segments, np.zeros(2), azimuth)
    if len(hits) == 0:
        return None
    opposite = radial_hits(segments, np.zeros(2), azimuth + np.pi)
    across = opposite[0] if len(opposite) else hits[0]
    if len(hits) >= 2 and hits[1] - hits[0] <= config.max_wall:
        return Wall(float(hits[0]), float(hits[1]), float(hits[0] + across))
    if len(hits) == 1:
        inner = float(hits[0]) - config.default_wall
        return Wall(inner, float(hits[0]), float(2 * inner), hollow=False)
    return None


def _rim_height(item: StandingObject, azimuth: float) -> float:
    """Return the height [m] of the highest vertex within 20 degrees of the azimuth."""
    angle = np.arctan2(item.vertices[:, 1], item.vertices[:, 0])
    near = np.abs(np.angle(np.exp(1j * (angle - azimuth)))) < np.deg2rad(20)
    return float(item.vertices[near, 2].max()) if near.any() else item.top


def _rim_grasp(
    item: StandingObject,
    sections: CrossSectionCache,
    slopes: _Slopes,
    azimuth: float,
    config: GraspConfig,
) -> Grasp | Rejected:
    """Return the deepest grasp at the rim whose inner fingertip is clear of the cavity's floor."""
    preferred = config.bowl_depth if item.category == "bowl" else config.mug_depth
    found: Grasp | Rejected = Rejected("too low")
    for fraction in config.depth_fractions:
        grasp = _rim_grasp_at(item, sections, slopes, azimuth, fraction * preferred, config)
        if isinstance(grasp, Rejected):
            found = found if isinstance(found, Grasp) else grasp
            continue
        if _fingertip_fits(sections, grasp, config):
            return grasp
        # The reconstructed floor may be too high: keep the grasp as a last resort.
        found = replace(grasp, score=grasp.score - 0.5)
    return found


def _fingertip_fits(sections: CrossSectionCache, grasp: Grasp, config: GraspConfig) -> bool:
    """Return whether the cavity reaches down to the inner fingertip; True where the mesh has no cavity."""
    T = grasp.T_stand_tcp
    tip = T[:3, 3] + config.gripper.tip * T[:3, 2]
    at_pad = wall_at(sections, float(T[2, 3]), grasp.azimuth, config)
    if at_pad is None or not at_pad.hollow:
        return True
    wall = wall_at(sections, float(tip[2]) - 0.001, grasp.azimuth, config)
    return (
        wall is not None and wall.hollow and wall.inner > float(np.linalg.norm(tip[:2])) - 0.5 * grasp.opening
    )


def _rim_grasp_at(
    item: StandingObject,
    sections: CrossSectionCache,
    slopes: _Slopes,
    azimuth: float,
    depth: float,
    config: GraspConfig,
) -> Grasp | Rejected:
    """Return the grasp at the rim at an azimuth [rad] and a depth [m]."""
    gripper = config.gripper
    rim = _rim_height(item, azimuth)
    wall = wall_at(sections, rim - depth, azimuth, config)
    if wall is None:
        return Rejected("too thick at the rim")
    slope = slopes.at(rim, depth, azimuth)
    hold = _depth_and_tilt(rim, depth, slope, config)
    if hold is None:
        return Rejected("too low")
    depth, tilt = hold
    pad_height = rim - depth * np.cos(tilt)
    wall = wall_at(sections, pad_height, azimuth, config) or wall
    room = wall.across - gripper.finger_thickness - 0.003
    half = min(config.half_opening, room - 0.5 * wall.thickness, 0.5 * gripper.max_width)
    if half - 0.5 * wall.thickness < 0.5 * config.min_half_opening or half < config.min_half_opening:
        return Rejected("too narrow inside")
    if wall.thickness < gripper.min_width + 0.0008:
        return Rejected(f"thinner than the closed hand, {1e3 * gripper.min_width:.1f} mm")
    even = min(pad_height, max(rim - _UNEVEN, 0.5 * rim))
    turn, bend = _turn_and_bend(
        sections, even, azimuth, wall_at(sections, even, azimuth, config) or wall, config
    )
    outward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    normal = np.array([np.cos(azimuth + turn), np.sin(azimuth + turn), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    along_wall = np.sin(tilt) * normal + np.cos(tilt) * up
    across = np.cos(tilt) * normal - np.sin(tilt) * up
    T = tcp_pose(wall.middle * outward + pad_height * up, approach=-along_wall, closing=across)
    retreat_angle = _retreat_angle(sections, rim, pad_height, azimuth, tilt)
    score = 1.0 - 2.0 * abs(slope - tilt) - 0.5 * abs(tilt) - _BENT * bend
    return Grasp(
        kind="rim",
        T_stand_tcp=T,
        away=np.sin(retreat_angle) * normal + np.cos(retreat_angle) * up,
        opening=min(2 * half, gripper.max_width),
        held_width=wall.thickness,
        closed_width=(gripper.min_width + 0.0008, max(min(wall.thickness + 0.014, 2 * half - 0.004), 0.012)),
        release_opening=min(wall.thickness + 2 * config.release_gap, 2 * half),
        depth=float(item.top - pad_height),
        azimuth=azimuth,
        score=score,
    )


class _Slopes:
    """Slopes of a wall: between pads of another slope an object turns as soon as it is lifted.

    Of a round object the median over all azimuths is taken; single places of a reconstruction are less exact.
    """

    def __init__(self, item: StandingObject, sections: CrossSectionCache) -> None:
        self._sections, self._is_round, self._top = sections, item.is_round, item.top
        self._of_round: dict[float, float] = {}

    def at(self, rim: float, depth: float, azimuth: float) -> float:
        """Return the angle [rad] of the wall to the vertical, positive if it widens upwards.

        Args:
            rim: height of the rim there in [m].
            depth: depth of the pads below it in [m].
            azimuth: azimuth in [rad].
        """
        if not self._is_round:
            return _slope(self._sections, rim, depth, azimuth)
        if depth not in self._of_round:
            slopes = [_slope(self._sections, self._top, depth, a) for a in _AZIMUTHS]
            self._of_round[depth] = float(np.median(slopes))
        return self._of_round[depth]


def _slope(sections: CrossSectionCache, rim: float, depth: float, azimuth: float) -> float:
    """Return the mean angle [rad] of both sides of the wall to the vertical, of the outer one of a solid.

    Measured over the height of the pads but not at the rim, which is rounded and may be uneven.
    """

    def sides(steps: Float[np.ndarray, "_k"]) -> tuple[float, float, float] | None:
        for z in rim - depth + steps:
            hits = radial_hits(sections.at(z), np.zeros(2), azimuth + 0.003)
            if len(hits):
                return z, float(hits[-1]), float(hits[-2]) if len(hits) > 1 else np.nan
        return None

    above = sides(min(0.007, 0.5 * depth) * np.array([1.0, 0.7, 0.4]))
    below = sides(np.array([-0.007, -0.005]))
    if above is None or below is None:
        return 0.0
    rise = above[0] - below[0]
    outer, inner = (float(np.arctan2(above[side] - below[side], rise)) for side in (1, 2))
    return outer if np.isnan(inner) else 0.5 * (outer + inner)


def _turn_and_bend(
    sections: CrossSectionCache, z: float, azimuth: float, wall: Wall, config: GraspConfig
) -> tuple[float, float]:
    """Return how a wall runs between the pads at a height [m] and an azimuth [rad], where it was measured.

    The first value is the angle [rad] of its normal to the radial direction, in plan view: pads of another
    direction turn a polygonal bowl when they close. The second is the angle [rad] by which the wall bends
    between the pads' edges, beyond that of a round one: at the corner of a polygon they touch edges only.
    """
    half = config.gripper.finger_half_width / wall.outer
    steps = np.linspace(-half, half, _PLAN_SAMPLES)
    radii = outermost(sections.at(z), azimuth + steps)
    if not (radii < wall.outer + config.max_wall).all():  # beside a handle
        return 0.0, 0.0
    points = radii[:, None] * np.column_stack([np.cos(steps), np.sin(steps)])
    directions = np.diff(points, axis=0)  # tangents; the normal of a round wall at step a is at a
    normals = np.arctan2(-directions[:, 0], directions[:, 1])
    middle = _PLAN_SAMPLES // 2
    before, after = float(normals[:middle].mean()), float(normals[middle:].mean())
    turn = float(np.clip(0.5 * (before + after), -_MOST_TURNED, _MOST_TURNED))
    return turn, max(0.0, after - before - half)


def _retreat_angle(
    sections: CrossSectionCache, rim: float, pad_height: float, azimuth: float, tilt: float
) -> float:
    """Return the angle [rad] to the vertical along which the fingers retreat past the wall above the pads.

    Walls become steeper towards the rim: a retreat along the tilt of the hand would drag the rim outwards.
    """
    at_pad = radial_hits(sections.at(pad_height), np.zeros(2), azimuth + 0.003)
    near_rim = radial_hits(sections.at(rim - 0.003), np.zeros(2), azimuth + 0.003)
    if len(at_pad) == 0 or len(near_rim) == 0 or rim - 0.003 - pad_height < 0.002:
        return tilt
    chord = float(np.arctan2(near_rim[-1] - at_pad[-1], rim - 0.003 - pad_height))
    return float(np.clip(chord, min(tilt, 0.0), max(tilt, 0.0)))


def _depth_and_tilt(
    rim: float, depth: float, slope: float, config: GraspConfig
) -> tuple[float, float] | None:
    """Return depth [m] and tilt [rad] with which the lower fingertip clears the support; None if too low.

    The wall's slope and the preferred depth if possible, else shallower, then less tilted.
    """
    tilt = float(np.clip(slope, -config.max_inward_tilt, config.max_tilt))
    if abs(tilt) < np.deg2rad(2):
        tilt = 0.0
    reach = config.half_opening + config.gripper.pad_thickness  # of the finger that the tilt lowers
    for fraction in (1.0, 0.5, 0.0):
        sine, cosine = abs(np.sin(fraction * tilt)), np.cos(fraction * tilt)
        room = rim - config.gripper.tip * cosine - reach * sine - config.fingertip_clearance
        if room / cosine >= config.min_depth:
            return min(depth, float(room / cosine)), fraction * tilt
    return None
