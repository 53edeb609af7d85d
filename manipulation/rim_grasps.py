"""Grasps over the rim of hollow objects, one finger inside, the hand tilted to the slope of the wall."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from manipulation.cross_sections import SectionCache
from manipulation.grasp_config import GraspConfig, tcp_pose, turned
from manipulation.standing import HANDLE_HALF_ANGLE
from manipulation.types import Grasp, StandingObject
from perception.mesh_sections import radial_hits


def rim_grasps(
    item: StandingObject, sections: SectionCache, config: GraspConfig, rejected: Counter[str]
) -> list[Grasp]:
    grasps = []
    for azimuth in 2 * np.pi * np.arange(config.n_azimuths) / config.n_azimuths:
        wrapped = np.angle(np.exp(1j * azimuth))
        if item.category == "mug" and abs(wrapped) < HANDLE_HALF_ANGLE - np.deg2rad(10):
            rejected["at the handle"] += 1
            continue
        grasp = _rim_grasp(item, sections, float(wrapped), config)
        if isinstance(grasp, str):
            rejected[grasp] += 1
            continue
        grasps += [grasp, turned(grasp)]
    return grasps


@dataclass(frozen=True)
class Wall:
    """A wall cut by a vertical half plane at one height: distances from the axis in [m].

    ``across`` is the distance from the inner side over the cavity to the opposite wall; ``hollow`` is False
    where the mesh has no cavity and the thickness is assumed.
    """

    inner: float
    outer: float
    across: float
    hollow: bool = True

    @property
    def middle(self) -> float:
        return 0.5 * (self.inner + self.outer)

    @property
    def thickness(self) -> float:
        return self.outer - self.inner


def wall_at(sections: SectionCache, z: float, azimuth: float, config: GraspConfig) -> Wall | None:
    """The wall at a height and direction; where the mesh has no cavity, a wall of the default thickness."""
    segments = sections.at(z)
    azimuth += 0.003  # beside the round angles at which meshes have their edges
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
    """Height of the rim near a direction: the highest vertex in a sector of 20 degrees."""
    angle = np.arctan2(item.vertices[:, 1], item.vertices[:, 0])
    near = np.abs(np.angle(np.exp(1j * (angle - azimuth)))) < np.deg2rad(20)
    return float(item.vertices[near, 2].max()) if near.any() else item.top


def _rim_grasp(
    item: StandingObject, sections: SectionCache, azimuth: float, config: GraspConfig
) -> Grasp | str:
    """The deepest grasp over the rim at an azimuth that leaves room for the inner fingertip, or why none."""
    wanted = config.bowl_depth if item.category == "bowl" else config.mug_depth
    found: Grasp | str = "too low"
    for share in config.depth_shares:
        grasp = _rim_grasp_at(item, sections, azimuth, share * wanted, config)
        if isinstance(grasp, str):
            found = found if isinstance(found, Grasp) else grasp
            continue
        if _fingertip_fits(sections, grasp, config):
            return grasp
        # The floor of the cavity may only look too high: keep it as a last resort.
        found = replace(grasp, score=grasp.score - 0.5)
    return found


def _fingertip_fits(sections: SectionCache, grasp: Grasp, config: GraspConfig) -> bool:
    """Whether the cavity reaches down to the inner fingertip; nobody knows where the mesh has none."""
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
    item: StandingObject, sections: SectionCache, azimuth: float, depth: float, config: GraspConfig
) -> Grasp | str:
    """The grasp over the rim at an azimuth and a depth, or why there is none."""
    gripper = config.gripper
    rim = _rim_height(item, azimuth)
    wall = wall_at(sections, rim - depth, azimuth, config)
    if wall is None:
        return "too thick at the rim"
    slope = _slope(sections, rim, depth, azimuth)
    hold = _depth_and_tilt(rim, depth, slope, config)
    if hold is None:
        return "too low"
    depth, tilt = hold
    pad_height = rim - depth * np.cos(tilt)
    wall = wall_at(sections, pad_height, azimuth, config) or wall
    room = wall.across - gripper.finger_thickness - 0.003
    half = min(config.half_opening, room - 0.5 * wall.thickness, 0.5 * gripper.max_width)
    if half - 0.5 * wall.thickness < 0.5 * config.min_half_opening or half < config.min_half_opening:
        return "too narrow inside"
    outward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    along_wall = np.sin(tilt) * outward + np.cos(tilt) * up
    across = np.cos(tilt) * outward - np.sin(tilt) * up
    T = tcp_pose(wall.middle * outward + pad_height * up, approach=-along_wall, closing=across)
    leaving = _leaving_angle(sections, rim, pad_height, azimuth, tilt)
    score = 1.0 - 2.0 * abs(slope - tilt) - 0.5 * abs(tilt)
    return Grasp(
        kind="rim",
        T_stand_tcp=T,
        away=np.sin(leaving) * outward + np.cos(leaving) * up,
        opening=min(2 * half, gripper.max_width),
        held_width=wall.thickness,
        closed_width=(0.0008, max(min(wall.thickness + 0.014, 2 * half - 0.004), 0.012)),
        release_opening=min(wall.thickness + 2 * config.release_gap, 2 * half),
        depth=float(item.top - pad_height),
        azimuth=azimuth,
        score=score,
    )


def _slope(sections: SectionCache, rim: float, depth: float, azimuth: float) -> float:
    """Angle of the outer side from the vertical below the rim [rad], positive where it widens upwards.

    Taken over the height of the pads, but not at the rim, which is rounded and need not be level.
    """

    def outer(steps: Float[np.ndarray, "_k"]) -> tuple[float, float] | None:
        for z in rim - depth + steps:
            hits = radial_hits(sections.at(z), np.zeros(2), azimuth + 0.003)
            if len(hits):
                return z, float(hits[-1])
        return None

    above = outer(min(0.007, 0.5 * depth) * np.array([1.0, 0.7, 0.4]))
    below = outer(np.array([-0.007, -0.005]))
    if above is None or below is None:
        return 0.0
    return float(np.arctan2(above[1] - below[1], above[0] - below[0]))


def _leaving_angle(
    sections: SectionCache, rim: float, pad_height: float, azimuth: float, tilt: float
) -> float:
    """Angle from the vertical [rad] at which fingers slide out past the wall above the pads.

    Walls bend upright towards the rim: a hand that left along its own tilt would drag the rim outwards.
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
    """Depth below the rim [m] and tilt of the hand [rad] that keep the lower fingertip off the support.

    The wall's slope and the wanted depth if possible; else shallower, then less tilted; None if too low.
    """
    tilt = float(np.clip(slope, -config.max_inward_tilt, config.max_tilt))
    if abs(tilt) < np.deg2rad(2):
        tilt = 0.0
    reach = config.half_opening + config.gripper.pad_thickness  # of the finger that a tilt lowers
    for share in (1.0, 0.5, 0.0):
        sine, cosine = abs(np.sin(share * tilt)), np.cos(share * tilt)
        room = rim - config.gripper.tip * cosine - reach * sine - config.fingertip_clearance
        if room / cosine >= config.least_depth:
            return min(depth, float(room / cosine)), share * tilt
    return None
