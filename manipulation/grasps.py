"""Grasp candidates by class, measured on the reconstructed mesh.

Hollow objects (mugs, bowls, open tumblers) are held by the rim with one finger inside, the hand tilted to the
slope of the wall where the pads touch. Cans and bottles are held from above around body, neck or cap, where
the section fits between the fingers and changes little over the height of the pads.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from manipulation.sections import SectionCache, Span, radial_hits, span
from manipulation.standing import HANDLE_HALF_ANGLE
from manipulation.types import Grasp, StandingObject


@dataclass(frozen=True)
class GripperGeometry:
    """The parallel gripper as grasp heuristics need it, in [m].

    Attributes:
        max_width: largest opening between the pads.
        pad_half_height: half the height of a pad along the approach.
        tip: how far the fingertips reach beyond the TCP.
        finger_thickness: of a finger above its pad, along the closing direction.
        palm: distance from the TCP back to the palm.
    """

    max_width: float = 0.08
    pad_half_height: float = 0.0085
    tip: float = 0.0095
    finger_thickness: float = 0.0185
    palm: float = 0.037


@dataclass(frozen=True)
class GraspConfig:
    """Where grasps are tried.

    Attributes:
        gripper: its geometry.
        n_azimuths: directions about the object's axis.
        mug_depth, bowl_depth: of the TCP below the rim, along the wall, in [m].
        depth_shares: of these depths to try, for shallow cavities.
        least_depth: for objects so low that the fingertips would meet the support, in [m].
        top_depths: of the TCP below the top of cans and bottles in [m].
        max_wall: thickest rim to close over in [m].
        default_wall: assumed thickness in [m] where the mesh has no cavity.
        half_opening: preferred distance of each pad from the middle of the wall before closing in [m].
        min_half_opening: least such distance in [m].
        release_gap: by which each finger lets go in [m].
        max_tilt, max_inward_tilt: of the hand, for walls that widen or narrow upwards, in [rad].
        pad_thickness: of a finger at its tip, along the closing direction, in [m].
        top_clearance: room at each finger before closing around a body in [m]; a little below 0, because the
            body may have been estimated too wide.
        max_taper: largest angle of a body's sides against the vertical, mean over the pads' height, in [rad]:
            friction holds cones up to it.
        fingertip_clearance: kept above the support in [m].
    """

    gripper: GripperGeometry = GripperGeometry()
    n_azimuths: int = 24
    mug_depth: float = 0.013
    bowl_depth: float = 0.0155
    depth_shares: tuple[float, ...] = (1.0, 0.8, 0.6)
    least_depth: float = 0.008
    top_depths: tuple[float, ...] = (0.022, 0.016, 0.028, 0.012, 0.032)
    max_wall: float = 0.02
    default_wall: float = 0.005
    half_opening: float = 0.016
    min_half_opening: float = 0.010
    release_gap: float = 0.0045
    max_tilt: float = np.deg2rad(32.0)
    max_inward_tilt: float = 0.15
    pad_thickness: float = 0.010
    top_clearance: float = -0.0015
    max_taper: float = np.deg2rad(27.0)
    fingertip_clearance: float = 0.005


@dataclass(frozen=True)
class GraspSet:
    """Candidates, best first, and why the others were dropped (reason: count)."""

    grasps: tuple[Grasp, ...]
    rejected: Counter[str]

    @property
    def n_tried(self) -> int:
        return len(self.grasps) + sum(self.rejected.values())

    def why_none(self, name: str) -> str:
        """One line for an object without a grasp: counts and a remedy."""
        counts = ", ".join(f"{count} {reason}" for reason, count in self.rejected.most_common(4))
        return f"No grasp for {name}: of {self.n_tried} tried, {counts}; leave it out or use a wider gripper"


def find_grasps(item: StandingObject, config: GraspConfig | None = None) -> GraspSet:
    """All grasps the object's class and shape offer, best first."""
    config = config or GraspConfig()
    rejected: Counter[str] = Counter()
    sections = SectionCache(item.vertices, item.faces)
    if item.category in ("mug", "bowl"):
        grasps = _rim_grasps(item, sections, config, rejected)
    else:
        grasps = _top_grasps(item, sections, config, rejected)
        if not grasps and _is_open(item, sections):
            grasps = _rim_grasps(item, sections, config, rejected)
    return GraspSet(tuple(sorted(grasps, key=lambda grasp: -grasp.score)), rejected)


def _rim_grasps(
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
        grasps += [grasp, _turned(grasp)]
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
    T = _tcp_pose(wall.middle * outward + pad_height * up, approach=-along_wall, closing=across)
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
    reach = config.half_opening + config.pad_thickness  # of the finger that a tilt lowers
    for share in (1.0, 0.5, 0.0):
        sine, cosine = abs(np.sin(share * tilt)), np.cos(share * tilt)
        room = rim - config.gripper.tip * cosine - reach * sine - config.fingertip_clearance
        if room / cosine >= config.least_depth:
            return min(depth, float(room / cosine)), share * tilt
    return None


def _top_grasps(
    item: StandingObject, sections: SectionCache, config: GraspConfig, rejected: Counter[str]
) -> list[Grasp]:
    grasps = []
    for rank, depth in enumerate(config.top_depths):
        for azimuth in np.pi * np.arange(config.n_azimuths // 2) / (config.n_azimuths // 2):
            grasp = _top_grasp(item, sections, float(azimuth), depth, config)
            if isinstance(grasp, str):
                rejected[grasp] += 1
                continue
            grasp = replace(grasp, score=grasp.score - 0.05 * rank)
            grasps += [grasp, _turned(grasp)]
    return grasps


def _top_grasp(
    item: StandingObject, sections: SectionCache, azimuth: float, depth: float, config: GraspConfig
) -> Grasp | str:
    """The grasp from above that closes along an azimuth, or why there is none."""
    gripper = config.gripper
    z = item.top - depth
    if z - gripper.tip < config.fingertip_clearance:
        return "too low"
    heights = z + gripper.pad_half_height * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    heights = heights[heights < item.top - 1e-4]
    spans = _spans(sections, heights, azimuth)
    above = _spans(sections, np.linspace(z - gripper.tip - 0.003, item.top - 1e-3, 10), azimuth)
    if len(spans) < 3 or not above:
        return "nothing to hold"
    widths = np.array([s.width for s in spans])
    middle = float(np.median([s.middle for s in spans]))
    reach = max(max(s.high - middle, middle - s.low) for s in above)
    if 2 * (reach + config.top_clearance) > gripper.max_width:
        return f"too wide for {gripper.max_width:.2f} m"
    taper = float(np.arctan2(np.ptp(widths) / 2, np.ptp(heights)))
    if taper > config.max_taper:
        return "too tapered"
    across = span(sections.at(z), azimuth + np.pi / 2)
    offset = across.middle if across is not None else 0.0
    closing = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    sideways = np.array([-closing[1], closing[0], 0.0])
    position = middle * closing + offset * sideways + np.array([0.0, 0.0, z])
    width = float(widths.max())
    opening = min(gripper.max_width, 2 * (reach + 0.012))
    up = np.array([0.0, 0.0, 1.0])
    return Grasp(
        kind="top",
        T_stand_tcp=_tcp_pose(position, approach=-up, closing=closing),
        away=up,
        opening=opening,
        held_width=width,
        closed_width=(0.5 * width, opening - 0.002),
        release_opening=min(2 * (reach + config.release_gap), gripper.max_width),
        depth=depth,
        azimuth=azimuth,
        score=1.0 - 1.5 * taper - 2.0 * max(width - 0.066, 0.0) / 0.01,
    )


def _spans(sections: SectionCache, heights: Float[np.ndarray, "_k"], azimuth: float) -> list[Span]:
    spans = (span(sections.at(z), azimuth) for z in heights)
    return [s for s in spans if s is not None]


def _is_open(item: StandingObject, sections: SectionCache) -> bool:
    """Whether the object has a wide cavity below its top, such as a tumbler."""
    hits = radial_hits(sections.at(item.top - 0.012), np.zeros(2), 0.1)
    return len(hits) >= 2 and bool(hits[0] > 0.02)


def _tcp_pose(position: np.ndarray, approach: np.ndarray, closing: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """TCP frame: z along the approach, y along the closing direction."""
    T = np.eye(4)
    T[:3, 2], T[:3, 1] = approach, closing
    T[:3, 0] = np.cross(closing, approach)
    T[:3, 3] = position
    return T


def _turned(grasp: Grasp) -> Grasp:
    """The same grasp with the hand turned by half a turn about its approach, the fingers swapped."""
    return replace(grasp, T_stand_tcp=grasp.T_stand_tcp @ np.diag([-1.0, -1.0, 1.0, 1.0]))
