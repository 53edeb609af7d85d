"""Grasps from above around body, neck or cap, where the cross-section is nearly constant over the pads."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from manipulation.cross_sections import CrossSectionCache, Extent, extent
from manipulation.grasp_config import GraspConfig, half_turn, tcp_pose
from manipulation.types import TOO_WIDE, Grasp, Rejected, StandingObject


def top_grasps(
    item: StandingObject, sections: CrossSectionCache, config: GraspConfig, rejected: Counter[str]
) -> list[Grasp]:
    """Return grasps from above over azimuths and depths; count the reasons of the others in ``rejected``."""
    grasps = []
    for rank, depth in enumerate(config.top_depths):
        for azimuth in np.pi * np.arange(config.n_azimuths // 2) / (config.n_azimuths // 2):
            grasp = _top_grasp(item, sections, float(azimuth), depth, config)
            if isinstance(grasp, Rejected):
                rejected[grasp.reason] += 1
                continue
            grasp = replace(grasp, score=grasp.score - 0.05 * rank)
            grasps += [grasp, half_turn(grasp)]
    return grasps


def _top_grasp(
    item: StandingObject, sections: CrossSectionCache, azimuth: float, depth: float, config: GraspConfig
) -> Grasp | Rejected:
    """Return the grasp from above that closes along ``azimuth`` [rad], ``depth`` [m] below the top."""
    gripper = config.gripper
    z = item.top - depth
    if z - gripper.tip < config.fingertip_clearance:
        return Rejected("too low")
    heights = z + gripper.pad_half_height * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    heights = heights[heights < item.top - 1e-4]
    held = _extents(sections, heights, azimuth)
    above = _extents(sections, np.linspace(z - gripper.tip - 0.003, item.top - 1e-3, 10), azimuth)
    if len(held) < 3 or not above:
        return Rejected("without material between the pads")
    widths = np.array([e.width for e in held])
    middle = float(np.median([e.middle for e in held]))
    reach = max(max(e.high - middle, middle - e.low) for e in above)
    if 2 * (reach + config.top_clearance) > gripper.max_width:
        return Rejected(f"{TOO_WIDE} for {gripper.max_width:.2f} m")
    taper = _taper(heights, widths)
    if taper > config.max_taper:
        return Rejected("too tapered")
    higher = heights + config.height_error
    higher = higher[higher < item.top - 1e-4]
    widths_higher = np.array([e.width for e in _extents(sections, higher, azimuth)])
    if len(widths_higher) == len(higher) > 1:
        taper = max(taper, _taper(higher, widths_higher))
    across = extent(sections.at(z), azimuth + np.pi / 2)
    offset = across.middle if across is not None else 0.0
    closing = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    sideways = np.array([-closing[1], closing[0], 0.0])
    position = middle * closing + offset * sideways + np.array([0.0, 0.0, z])
    width = float(widths.max())
    opening = min(gripper.max_width, 2 * (reach + 0.012))
    up = np.array([0.0, 0.0, 1.0])
    return Grasp(
        kind="top",
        T_stand_tcp=tcp_pose(position, approach=-up, closing=closing),
        away=up,
        opening=opening,
        held_width=width,
        closed_width=(0.5 * width, opening - 0.002),
        release_opening=min(2 * (reach + config.release_gap), gripper.max_width),
        depth=depth,
        azimuth=azimuth,
        score=1.0 - 1.5 * taper - 2.0 * max(width - (gripper.max_width - 0.014), 0.0) / 0.01,
    )


def _taper(heights: Float[np.ndarray, "k"], widths: Float[np.ndarray, "_k"]) -> float:
    """Return the mean angle of the sides to the vertical in [rad]."""
    return float(np.arctan2(np.ptp(widths) / 2, np.ptp(heights)))


def _extents(sections: CrossSectionCache, heights: Float[np.ndarray, "_k"], azimuth: float) -> list[Extent]:
    """Return the extents of the non-empty cross-sections at the heights [m]."""
    extents = (extent(sections.at(z), azimuth) for z in heights)
    return [e for e in extents if e is not None]
