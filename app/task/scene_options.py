"""Scene options of a cell: resting poses, gaps, things of no class, calibration error, friction, region."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from app.errors import UsageError
from app.options import CellOptions

if TYPE_CHECKING:
    from sim_assets.cell.arrangement import Arrangement

MOST_UNKNOWN = 8
MOST_VIEWS = 6  # of the scan
GAP_MAX = 0.2  # [m]
CAMERA_ERROR_MAX = (50.0, 10.0)  # [mm], [deg]
FRICTION_LIMITS = (0.05, 2.0)
TABLE_REGION = ((0.20, 0.80), (-0.58, 0.0))  # [m], x and y of the region for objects
_CLUTTERED = {"lying": 1 / 4, "upside_down": 1 / 8, "stacked": 1 / 4, "unknown": 3 / 8}  # per object


def check_scene(options: CellOptions) -> None:
    """Validate the scene options.

    Raises:
        UsageError: An option is invalid; the message names it and its valid values.
    """
    for name in ("lying", "upside_down", "stacked", "unknown"):
        value, most = getattr(options, name), MOST_UNKNOWN if name == "unknown" else 20
        if not 0 <= value <= most:
            raise UsageError(f"--{name.replace('_', '-')} {value} must be in 0..{most}")
    if options.gap is not None and not 0 <= options.gap <= GAP_MAX:
        raise UsageError(f"--gap {options.gap:g} m must be in 0..{GAP_MAX:g} m")
    view_counts(getattr(options, "scan_views", MOST_VIEWS))
    camera_error(options)
    friction(options)
    region_limits(options)


def view_counts(scan_views: int | str) -> tuple[int, ...]:
    """Return the numbers of images of --scan-views: one, or several to be compared.

    Raises:
        UsageError: They are not different numbers in 1..MOST_VIEWS.
    """
    numbers = [text.strip() for text in str(scan_views).split(",")]
    known = [int(text) for text in numbers if text.isdecimal() and len(text) < 3]
    if len(known) < len(numbers) or not all(1 <= n <= MOST_VIEWS for n in known):
        raise UsageError(f"--scan-views {scan_views} must be in 1..{MOST_VIEWS}")
    if len(set(known)) < len(known):
        raise UsageError(f"--scan-views {scan_views} takes different numbers")
    return tuple(known)


def counts(options: CellOptions, n_objects: int) -> dict[str, int]:
    """Return ``lying``, ``upside_down``, ``stacked`` and ``unknown``; with --clutter, of its mixture.

    The mixture stacks no more objects than there are pairs of those that neither lie nor stand on their rim.
    """
    mixture = {name: round(share * n_objects) if options.clutter else 0 for name, share in _CLUTTERED.items()}
    lying = options.lying or mixture["lying"]
    upside_down = options.upside_down or mixture["upside_down"]
    mixture["stacked"] = min(mixture["stacked"], max(n_objects - lying - upside_down, 0) // 2)
    return {name: getattr(options, name) or default for name, default in mixture.items()}


def camera_error(options: CellOptions) -> tuple[float, float]:
    """Return translation [m] and rotation [rad] of --camera-error."""
    millimetres, degrees = _numbers("--camera-error", options.camera_error, "MM,DEG such as 3,0.5", 2)
    for value, most, unit in (
        (millimetres, CAMERA_ERROR_MAX[0], "mm"),
        (degrees, CAMERA_ERROR_MAX[1], "deg"),
    ):
        if not 0 <= value <= most:
            raise UsageError(f"--camera-error {value:g} {unit} must be in 0..{most:g} {unit}")
    return millimetres / 1000, math.radians(degrees)


def friction(options: CellOptions) -> tuple[float, float] | None:
    """Return the range of --friction; None if it is not given."""
    if not options.friction:
        return None
    low, high = _numbers("--friction", options.friction, "LOW,HIGH such as 0.35,1.0", 2)
    if not FRICTION_LIMITS[0] <= low <= high <= FRICTION_LIMITS[1]:
        limits = f"{FRICTION_LIMITS[0]:g}..{FRICTION_LIMITS[1]:g}"
        raise UsageError(f"--friction {options.friction} must be ascending in {limits}")
    return low, high


def region_limits(options: CellOptions) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return the ranges of x and y [m] of --region; None if it is not given."""
    if not options.region:
        return None
    x0, x1, y0, y1 = _numbers("--region", options.region, "X0,X1,Y0,Y1 such as 0.3,0.62,-0.5,-0.05", 4)
    (left, right), (front, back) = TABLE_REGION
    if not (left <= x0 < x1 <= right and front <= y0 < y1 <= back):
        limits = f"x {left:g}..{right:g}, y {front:g}..{back:g} m"
        raise UsageError(f"--region {options.region} must be ascending ranges in {limits}")
    return (x0, x1), (y0, y1)


def scene_settings(options: CellOptions, n_objects: int, seed: np.random.SeedSequence) -> dict[str, Any]:
    """Return the fields of ``CellConfig`` that the scene options set; nothing for their defaults.

    Args:
        options: Options of the cell.
        n_objects: Number of objects.
        seed: Seed of the things of no class.
    """
    from sim_assets.cell.layout import Region
    from sim_assets.cell.unknown import draw_unknown

    numbers = counts(options, n_objects)
    settings: dict[str, Any] = {
        "arrangement": _arrangement(numbers),
        "unknown": draw_unknown(numbers["unknown"], np.random.default_rng(seed)),
        "camera_error": camera_error(options),
        "friction": friction(options),
    }
    gap = 0.0 if options.gap is None and options.clutter else options.gap
    if gap is not None:
        settings |= {"min_gap": gap, "drawn_together": True}
    limits = region_limits(options)
    if limits is not None:
        settings["region"] = Region(*limits, max_radius=Region.max_radius + 0.1)
    return settings


def _arrangement(numbers: dict[str, int]) -> Arrangement:
    from sim_assets.cell.arrangement import Arrangement

    return Arrangement(numbers["lying"], numbers["upside_down"], numbers["stacked"])


def _numbers(option: str, text: str, form: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise UsageError(f"{option} takes {form}, not '{text}'")
    return values
