"""Grasps from above around body, neck or cap, where the section changes little over the pads' height."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from manipulation.cross_sections import SectionCache, Span, span
from manipulation.grasp_config import GraspConfig, tcp_pose, turned
from manipulation.types import Grasp, StandingObject


def top_grasps(
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
            grasps += [grasp, turned(grasp)]
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


def _spans(sections: SectionCache, heights: Float[np.ndarray, "_k"], azimuth: float) -> list[Span]:
    spans = (span(sections.at(z), azimuth) for z in heights)
    return [s for s in spans if s is not None]
