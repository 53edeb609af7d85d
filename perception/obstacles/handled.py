"""Lying bottles and cans that a handle belongs to: the barrel of a hair dryer, the head of a hammer.

Alone, either is fitted well. A thin piece whose end meets the side of a body, across its axis and in its
colours, is its handle, and so is what was taken for an object itself, if it is slender beside the body: the
grip of a drill. Colours are compared by their histograms: a thing with prints seldom has one colour that goes
on from one to the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from perception.detection.geometry import points_of
from perception.geometry import invert, transform_points
from perception.inference.clear_evidence import is_thin
from perception.metrics import SurfaceSamples
from perception.obstacles.unexplained import raised_pixels
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

_SAMPLES = 6000  # of a surface
_BINS = np.arange(-96.0, 97.0, 16.0)  # of a and b
_SMOOTHING = 0.7  # standard deviation in bins


@dataclass(frozen=True)
class HandledConfig:
    """What the handle of a body is; lengths in metres, colours in CIE Lab.

    Attributes:
        contact: Largest distance of its end from the body.
        end: Distance from its end, in its radii, up to which it meets the body.
        across: Least angle between both axes, in radians.
        slender: Largest radius of a handle that was taken for an object, relative to that of the body: two
            of the same product may lie at right angles.
        own: Distance from a surface up to which a measured point shows it.
        min_points: Smallest number of points that show the colours of either.
        lightness: Largest difference of their median lightness.
        alike: Least intersection of the histograms of a and b. In two scans it was 0.80, 0.89 and 0.96 for
            hair dryers, 0.58 and less for bottles beside them.
    """

    contact: float = 0.006
    end: float = 1.5
    across: float = np.radians(50)
    slender: float = 0.7
    own: float = 0.005
    min_points: int = 100
    lightness: float = 15.0
    alike: float = 0.7


def with_handle(
    objects: Sequence[ObjectEstimate],
    pieces: Sequence[ObjectEstimate],
    views: Sequence[RgbdFrame],
    plane: SupportPlane,
    config: HandledConfig = HandledConfig(),
) -> set[int]:
    """Return the ids of the lying bottles and cans that have a handle, and of such handles among the objects.

    Args:
        objects: Object map.
        pieces: Estimates of what is no object, because its shape does not suffice.
        views: Images without flying pixels and without the robot, with camera poses.
        plane: Support plane.
        config: What a handle is.
    """
    lying = [e for e in objects if e.resting == "lying"]
    bodies = [e for e in lying if e.category in ("bottle", "can")]
    thin = [e for e in pieces if e.resting == "lying" and is_thin(e)]

    def is_handle(one: ObjectEstimate, body: ObjectEstimate) -> bool:
        return _begins_at(one, body, config) and _are_alike(one, body, views, plane, config)

    parts: set[int] = set()
    for body in bodies:
        slender = [e for e in lying if e.radius < config.slender * body.radius]
        taken = {e.id for e in slender if is_handle(e, body)}
        if taken or any(is_handle(piece, body) for piece in thin):
            parts |= {body.id, *taken}
    return parts


def _surface(estimate: ObjectEstimate) -> SurfaceSamples:
    return SurfaceSamples.of(estimate.mesh_world, np.random.default_rng(0), _SAMPLES)


def _begins_at(handle: ObjectEstimate, body: ObjectEstimate, config: HandledConfig) -> bool:
    """Return whether the end of a handle meets a body, across its axis."""
    along = abs(body.T_world_object[:3, 2] @ handle.T_world_object[:3, 2])
    if handle.id == body.id or along > np.cos(config.across):
        return False
    points = _surface(handle).points
    distance = _surface(body).distance(points, 2 * config.contact)
    nearest = int(distance.argmin())
    z = transform_points(invert(handle.T_world_object), points[nearest][None])[0, 2]
    low, high = handle.mesh.vertices[:, 2].min(), handle.mesh.vertices[:, 2].max()
    return bool(distance[nearest] < config.contact and min(z - low, high - z) < config.end * handle.radius)


def _are_alike(
    one: ObjectEstimate,
    other: ObjectEstimate,
    views: Sequence[RgbdFrame],
    plane: SupportPlane,
    config: HandledConfig,
) -> bool:
    """Return whether all that is measured of two objects has the same colours."""
    colors = [_colors(e, views, plane, config) for e in (one, other)]
    if min(map(len, colors)) < config.min_points:
        return False
    first, second = (np.median(lab[:, 0]) for lab in colors)
    alike = float(np.minimum(*(_histogram(lab[:, 1:]) for lab in colors)).sum())
    return bool(abs(first - second) < config.lightness and alike > config.alike)


def _colors(
    estimate: ObjectEstimate, views: Sequence[RgbdFrame], plane: SupportPlane, config: HandledConfig
) -> Float[np.ndarray, "n 3"]:
    """Return the colours in CIE Lab of the points that show an object, over all views."""
    surface = _surface(estimate)
    shown: list[np.ndarray] = [np.zeros((0, 3), np.float32)]
    for view in views:
        raised = raised_pixels(view, plane)
        if raised.any():
            lab = cv2.cvtColor(view.rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[raised]
            shown.append(lab[surface.distance(points_of(view, raised), 2 * config.own) < config.own])
    return np.concatenate(shown)


def _histogram(colors: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "b b"]:
    """Return the smoothed histogram of a and b, with sum 1."""
    counts = np.histogramdd(colors, bins=[_BINS, _BINS])[0]
    smooth = cv2.GaussianBlur(counts, (3, 3), _SMOOTHING)
    return np.asarray(smooth / max(smooth.sum(), 1e-9))
