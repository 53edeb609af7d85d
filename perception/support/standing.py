"""Which surface the object in a mask stands on, and why it stands on none.

An object touches its surface, lies within the extent of it, and does not reach below it. Where its base is
hidden or was not measured, whether it touches is left open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from perception.detection.geometry import bounding_window, in_image, points_of, project
from perception.detection.left_out import LeftOut
from perception.support.samples import depth_noise
from perception.support.surface import SupportSurface
from perception.types import RgbdFrame


@dataclass(frozen=True)
class StandingConfig:
    """Tolerances; lengths in metres, to which three standard deviations of the depth are added.

    Attributes:
        max_distance: Largest median depth of an object.
        margin: Distance beyond the outline at which a point is no longer above the surface.
        max_outside: Largest share of an object's points beyond the outline.
        max_gap: Largest height of the lowest points, and depth of points below the surface.
        max_below: Largest share of points below the surface.
        min_height: Height from which points count as the object's rather than the surface's.
        max_points: Number of points that are examined.
    """

    max_distance: float = 2.0
    margin: float = 0.025
    max_outside: float = 0.5
    max_gap: float = 0.02
    max_below: float = 0.15
    min_height: float = 0.01
    max_points: int = 600


@dataclass(frozen=True)
class MeasuredObject:
    """The measured points of a mask.

    Attributes:
        frame: Image.
        mask: (H, W) bool.
        points: (n, 3) world points away from the mask's border, in metres.
        distance: Median depth in metres.
        noise: Three standard deviations of the depth at that distance, in metres.
    """

    frame: RgbdFrame
    mask: Bool[np.ndarray, "h w"]
    points: Float[np.ndarray, "n 3"]
    distance: float
    noise: float

    @staticmethod
    def of(
        frame: RgbdFrame, mask: Bool[np.ndarray, "h w"], config: StandingConfig = StandingConfig()
    ) -> MeasuredObject | None:
        """Return the measured points of a mask; None if it has none.

        Pixels at its border are left out where it has others: they are often the background's.
        """
        window = bounding_window(mask, 1)
        core = np.zeros_like(mask)
        inner = cv2.erode(mask[window].astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=1)
        core[window] = np.asarray(inner) > 0
        measured = core & (frame.depth > 0)
        if measured.sum() < 0.2 * mask.sum():
            measured = mask & (frame.depth > 0)
        if not measured.any():
            return None
        distance = float(np.median(frame.depth[measured]))
        points = points_of(frame, measured)
        points = points[:: len(points) // config.max_points + 1]
        return MeasuredObject(frame, mask, points, distance, float(3 * depth_noise(np.array(distance))))


def support_of(
    seen: MeasuredObject, surfaces: Sequence[SupportSurface], config: StandingConfig = StandingConfig()
) -> int:
    """Return the index of the highest surface that the object can stand on; 0 if it stands on none."""
    best, best_base = 0, np.inf
    for index, surface in enumerate(surfaces):
        height = surface.plane.height_above(seen.points)
        base = float(np.percentile(height, 5))
        stands = base > -config.max_gap - seen.noise and not _is_beyond(seen, height, surface, config)
        if stands and base < best_base - config.max_gap:
            best, best_base = index, base
    return best


def misplacement(
    seen: MeasuredObject, surface: SupportSurface, config: StandingConfig = StandingConfig()
) -> LeftOut | None:
    """Return why the object does not stand on the surface; None if it does or may do."""
    if seen.distance > config.max_distance:
        detail = f"{seen.distance:.1f} m; searched up to {config.max_distance:g} m"
        return LeftOut(seen.mask, "too far", detail)
    height = surface.plane.height_above(seen.points)
    gap = config.max_gap + seen.noise
    if _is_beyond(seen, height, surface, config):
        return LeftOut(seen.mask, "beyond the edge of the support surface")
    if np.percentile(height, 95) < max(config.min_height, seen.noise) and np.percentile(height, 5) > -gap:
        detail = f"{1000 * max(0.0, np.percentile(height, 95)):.0f} mm"
        return LeftOut(seen.mask, "does not rise above the support surface", detail)
    below = float((height < -gap).mean())
    if below > config.max_below:
        return LeftOut(seen.mask, "reaches below the support surface", f"{100 * -height.min():.0f} cm")
    base = float(np.percentile(height, 5))
    if base > gap and _is_clear_below(seen, height, surface, config.min_height + seen.noise):
        return LeftOut(seen.mask, "does not touch the support surface", f"{100 * base:.0f} cm above it")
    return None


def _is_beyond(
    seen: MeasuredObject, height: Float[np.ndarray, "n"], surface: SupportSurface, config: StandingConfig
) -> bool:
    """Return whether most of the points above or below the surface lie beyond its outline."""
    apart = seen.points[np.abs(height) > max(config.min_height, seen.noise)]
    if not len(apart):
        return False
    return bool((surface.beyond(apart) > config.margin).mean() > config.max_outside)


def _is_clear_below(
    seen: MeasuredObject, height: Float[np.ndarray, "n"], surface: SupportSurface, margin: float
) -> bool:
    """Return whether the camera looks through between the lowest points and the surface below them.

    Where the object, or something in front of it, fills that space, rays end there at the latest.
    """
    low = height <= np.percentile(height, 20)
    clear = np.ones(int(low.sum()), bool)
    for share in (1 / 3, 2 / 3):
        between = seen.points[low] - share * height[low, None] * surface.plane.normal
        pixels, z = project(seen.frame, between)
        inside = in_image(seen.frame, pixels, z)
        u, v = np.where(inside[:, None], pixels, 0).T
        clear &= inside & (seen.frame.depth[v, u] > z + margin)  # missing depth is 0: not clear
    return bool(clear.mean() > 0.5)
