"""Lying bottles and cans between the halves of another thing: the fuselage of an aeroplane with its wings.

Things that lie at both sides of an object are seldom of one colour. Where what belongs to no object goes away
from it at opposite sides, at the same place along its axis, as high and in one colour, it goes through it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from perception.detection.geometry import points_of
from perception.geometry import invert, transform_points
from perception.obstacles.unexplained import KnownGeometry, raised_pixels
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane


@dataclass(frozen=True)
class CrossingConfig:
    """What crosses an object; lengths in metres, colours in CIE Lab.

    Attributes:
        margin: Distance from the objects from which on a point belongs to none.
        reach: Distance from the object that what crosses it reaches at both sides at least.
        step: Intervals of that distance, each of which is to hold points.
        width: Length along the axis that is looked at at a time.
        min_points: Smallest number of points in an interval, over all views.
        height: Largest difference of the mean height of both sides.
        above: Largest height of a point above the object.
        lightness: Largest difference of both sides' lightness, which shading changes.
        chroma: Largest difference of their a and b.
    """

    margin: float = 0.008
    reach: float = 0.04
    step: float = 0.008
    width: float = 0.016
    min_points: int = 10
    height: float = 0.012
    above: float = 0.01
    lightness: float = 15.0
    chroma: float = 8.0


def crossed(
    objects: Sequence[ObjectEstimate],
    views: Sequence[RgbdFrame],
    plane: SupportPlane,
    config: CrossingConfig = CrossingConfig(),
) -> set[int]:
    """Return the ids of the lying bottles and cans that something of no class goes through.

    Args:
        objects: Object map.
        views: Images without flying pixels and without the robot, with camera poses.
        plane: Support plane.
        config: What crosses an object.
    """
    lying = [e for e in objects if e.resting == "lying" and e.category in ("bottle", "can")]
    if not lying:
        return set()
    points, colors = _raised(views, plane)
    is_open = ~KnownGeometry.of(objects).explains(points, config.margin)
    points, colors = points[is_open], colors[is_open]
    return {e.id for e in lying if _is_crossed(e, points, colors, plane, config)}


def _is_crossed(
    estimate: ObjectEstimate,
    points: Float[np.ndarray, "n 3"],
    colors: Float[np.ndarray, "n 3"],
    plane: SupportPlane,
    config: CrossingConfig,
) -> bool:
    """Return whether points that belong to no object go through one, given with their colours."""
    axis = estimate.T_world_object[:3, 2]
    across = np.cross(plane.normal, axis)
    offset = (points - estimate.T_world_object[:3, 3]) @ (across / np.linalg.norm(across))
    along = transform_points(invert(estimate.T_world_object), points)[:, 2]
    height = plane.height_above(points)
    is_low = height < plane.height_above(estimate.mesh_world.vertices).max() + config.above
    vertices = estimate.mesh.vertices
    for low in np.arange(vertices[:, 2].min(), vertices[:, 2].max() - config.width, config.width / 2):
        own = vertices[(vertices[:, 2] >= low) & (vertices[:, 2] < low + config.width)]
        if not len(own):
            continue
        outside = np.abs(offset) - np.linalg.norm(own[:, :2], axis=1).max()
        near = is_low & (along >= low) & (along < low + config.width)
        near &= (outside > 0) & (outside < config.reach)
        sides = [np.flatnonzero(near & (offset > 0)), np.flatnonzero(near & (offset < 0))]
        if all(_goes_on(outside[side], config) for side in sides):
            right, left = (np.column_stack([height[side], colors[side]]) for side in sides)
            if _are_alike(right, left, config):
                return True
    return False


def _goes_on(outside: Float[np.ndarray, "n"], config: CrossingConfig) -> bool:
    """Return whether points lie at all distances from an object, the first of which the margin leaves out."""
    edges = np.arange(0.0, config.reach + config.step / 2, config.step)
    counts, _ = np.histogram(outside, edges)
    return bool((counts[1:] >= config.min_points).all())


def _are_alike(
    one: Float[np.ndarray, "n 4"], other: Float[np.ndarray, "m 4"], config: CrossingConfig
) -> bool:
    """Return whether points at both sides are as high and of one colour, given as (height, L, a, b)."""
    height, lightness, *chroma = np.abs(np.median(one, axis=0) - np.median(other, axis=0))
    same_colour = lightness < config.lightness and np.hypot(*chroma) < config.chroma
    return bool(height < config.height and same_colour)


def _raised(
    views: Sequence[RgbdFrame], plane: SupportPlane
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return the measured points above the support in the world frame [m], and their colours in CIE Lab."""
    points: list[np.ndarray] = [np.zeros((0, 3))]
    colors: list[np.ndarray] = [np.zeros((0, 3), np.float32)]
    for view in views:
        raised = raised_pixels(view, plane)
        if raised.any():
            points.append(points_of(view, raised))
            colors.append(cv2.cvtColor(view.rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[raised])
    return np.concatenate(points), np.concatenate(colors)
