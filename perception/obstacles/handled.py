"""Lying bottles and cans that a handle belongs to: the barrel of a hair dryer, the head of a hammer.

Alone, either is fitted well. A thin piece whose end meets the side of a body, across its axis and in its
colour, is its handle; prints of several colours on both hide that one goes on in the other.
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


@dataclass(frozen=True)
class HandledConfig:
    """What the handle of a body is; lengths in metres, colours in CIE Lab.

    Attributes:
        contact: Largest distance of its end from the body.
        end: Distance from its end, in its radii, up to which it meets the body.
        across: Least angle between both axes, in radians.
        own: Distance from a surface up to which a measured point shows it.
        near: Distance from the contact up to which the colour of the body is looked at.
        min_points: Smallest number of points that show the colour of either.
        lightness: Largest difference of lightness.
        chroma: Largest difference of a and b of greyish colours.
        relative_chroma: The same of colourful ones, relative to their chroma.
    """

    contact: float = 0.006
    end: float = 1.5
    across: float = np.radians(50)
    own: float = 0.005
    near: float = 0.05
    min_points: int = 100
    lightness: float = 15.0
    chroma: float = 8.0
    relative_chroma: float = 0.5


def with_handle(
    objects: Sequence[ObjectEstimate],
    pieces: Sequence[ObjectEstimate],
    views: Sequence[RgbdFrame],
    plane: SupportPlane,
    config: HandledConfig = HandledConfig(),
) -> set[int]:
    """Return the ids of the lying bottles and cans that have a handle.

    Args:
        objects: Object map.
        pieces: Estimates of what is no object, because its shape does not suffice.
        views: Images without flying pixels and without the robot, with camera poses.
        plane: Support plane.
        config: What a handle is.
    """
    bodies = [e for e in objects if e.resting == "lying" and e.category in ("bottle", "can")]
    handles = [e for e in pieces if e.resting == "lying" and is_thin(e)]
    found: set[int] = set()
    for body in bodies if handles else ():
        surface = _surface(body)
        for handle in handles:
            contact = _contact(body, surface, handle, config)
            if contact is not None and _are_alike(surface, _surface(handle), contact, views, plane, config):
                found.add(body.id)
    return found


def _surface(estimate: ObjectEstimate) -> SurfaceSamples:
    return SurfaceSamples.of(estimate.mesh_world, np.random.default_rng(0), _SAMPLES)


def _contact(
    body: ObjectEstimate, surface: SurfaceSamples, handle: ObjectEstimate, config: HandledConfig
) -> Float[np.ndarray, "3"] | None:
    """Return the world point [m] at which the end of a handle meets a body; None if it does not."""
    along = abs(body.T_world_object[:3, 2] @ handle.T_world_object[:3, 2])
    if handle.id == body.id or along > np.cos(config.across):
        return None
    points = _surface(handle).points
    distance = surface.distance(points, 2 * config.contact)
    nearest = int(distance.argmin())
    z = transform_points(invert(handle.T_world_object), points[nearest][None])[0, 2]
    low, high = handle.mesh.vertices[:, 2].min(), handle.mesh.vertices[:, 2].max()
    at_end = min(z - low, high - z) < config.end * handle.radius
    return points[nearest] if at_end and distance[nearest] < config.contact else None


def _are_alike(
    body: SurfaceSamples,
    handle: SurfaceSamples,
    contact: Float[np.ndarray, "3"],
    views: Sequence[RgbdFrame],
    plane: SupportPlane,
    config: HandledConfig,
) -> bool:
    """Return whether a handle and the body around their contact have one colour, in the median."""
    of_body: list[np.ndarray] = [np.zeros((0, 3), np.float32)]
    of_handle: list[np.ndarray] = [np.zeros((0, 3), np.float32)]
    for view in views:
        raised = raised_pixels(view, plane)
        if not raised.any():
            continue
        points = points_of(view, raised)
        colors = cv2.cvtColor(view.rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[raised]
        near = np.linalg.norm(points - contact, axis=1) < config.near
        of_body.append(colors[near & (body.distance(points, 2 * config.own) < config.own)])
        of_handle.append(colors[handle.distance(points, 2 * config.own) < config.own])
    one, other = np.concatenate(of_body), np.concatenate(of_handle)
    if min(len(one), len(other)) < config.min_points:
        return False
    color = np.median(one, axis=0)
    lightness, *chroma = np.abs(color - np.median(other, axis=0))
    most = max(config.chroma, config.relative_chroma * float(np.hypot(*color[1:])))
    return bool(lightness < config.lightness and np.hypot(*chroma) < most)
