"""Objects that go on in their own colour: the barrel of a hair dryer, the lens of a camera, a shoe's shaft.

What lies beside another thing seldom has its colour as well. Where an object is continued without a step in
colour by what no object explains, away from its axis and farther than a cap may, both are one thing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from perception.detection.geometry import points_of
from perception.geometry import invert, transform_points
from perception.metrics import SurfaceSamples
from perception.obstacles.unexplained import KnownGeometry, raised_pixels
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

SAME_COLOUR = "something that belongs to none of the classes continues it in its colour"
_SAMPLES = 8000  # of an object's surface


@dataclass(frozen=True)
class ColourConfig:
    """What continues an object; lengths in metres, colours in CIE Lab.

    Attributes:
        margin: Distance from the objects from which on a point belongs to none.
        own: Distance from an object's surface up to which a point shows it.
        contact: Distance from it up to which what belongs to no object touches it.
        reach: Distance from it that what continues it reaches at least.
        near: Largest distance from it that is looked at.
        aside: Distance from the axis, beyond the radius, from which on a point cannot be the rest of an
            object whose length was estimated too small.
        lightness: Largest difference of lightness: shading changes it.
        chroma: Largest difference of a and b of greyish colours.
        relative_chroma: The same of colourful ones, relative to their chroma, which shading changes too.
        min_pixels: Smallest number of pixels of the object, and of what reaches so far, in one image.
        min_views: Smallest number of images that show so.
        lowest: Least height above the support of what continues an object.
    """

    margin: float = 0.008
    own: float = 0.005
    contact: float = 0.014
    reach: float = 0.030
    near: float = 0.10
    aside: float = 0.012
    lightness: float = 12.0
    chroma: float = 4.0
    relative_chroma: float = 0.15
    min_pixels: int = 100
    min_views: int = 3
    lowest: float = 0.0


ONE_VIEW = ColourConfig(lowest=0.03)  # saucers and plates are lower


def continued_in_colour(
    objects: Sequence[ObjectEstimate],
    views: Sequence[RgbdFrame],
    plane: SupportPlane,
    config: ColourConfig = ColourConfig(),
) -> set[int]:
    """Return the ids of the lying bottles and cans that something of no class continues in their colour.

    Args:
        objects: Object map.
        views: Images without flying pixels and without the robot, with camera poses.
        plane: Support plane.
        config: What continues an object.
    """
    lying = [e for e in objects if e.resting == "lying" and e.category in ("bottle", "can")]
    if not lying:
        return set()
    surfaces, known = _surfaces(lying), KnownGeometry.of(objects)
    shown = [id for view in views for id in _continued(lying, surfaces, known, view, plane, config)]
    return {id for id in surfaces if shown.count(id) >= config.min_views}


def continued_in_one_view(
    objects: Sequence[ObjectEstimate],
    known: Sequence[ObjectEstimate],
    view: RgbdFrame,
    plane: SupportPlane,
    occupied: Bool[np.ndarray, "h w"],
    config: ColourConfig = ONE_VIEW,
) -> set[int]:
    """Return the ids of objects that something of no class continues in their colour: the shaft of a shoe.

    A single image shows a mug without its handle; what it goes on in is seen all the same.

    Args:
        objects: The objects in question, seen in this image.
        known: All objects.
        view: Image without flying pixels, with its camera pose.
        plane: Support plane.
        occupied: Pixels of what may be further objects, although they were left out.
        config: What continues an object.
    """
    if not objects:
        return set()
    return set(
        _continued(objects, _surfaces(objects), KnownGeometry.of(known), view, plane, config, occupied)
    )


def _surfaces(objects: Sequence[ObjectEstimate]) -> dict[int, SurfaceSamples]:
    rng = np.random.default_rng(0)
    return {e.id: SurfaceSamples.of(e.mesh_world, rng, _SAMPLES) for e in objects}


def _continued(
    objects: Sequence[ObjectEstimate],
    surfaces: Mapping[int, SurfaceSamples],
    known: KnownGeometry,
    view: RgbdFrame,
    plane: SupportPlane,
    config: ColourConfig,
    occupied: Bool[np.ndarray, "h w"] | None = None,
) -> Iterator[int]:
    """Yield the ids of the objects that something of no class continues in one image."""
    raised = raised_pixels(view, plane)
    points = points_of(view, raised)
    colors = cv2.cvtColor(view.rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    is_open = np.zeros_like(raised)
    is_high = plane.height_above(points) > config.lowest
    is_open[raised] = is_high & ~known.explains(points, config.margin)
    if occupied is not None:
        is_open &= ~occupied
    for e in objects:
        if _continues(e, surfaces[e.id], points, raised, is_open, colors, config):
            yield e.id


def _continues(
    estimate: ObjectEstimate,
    surface: SurfaceSamples,
    points: Float[np.ndarray, "n 3"],
    raised: Bool[np.ndarray, "h w"],
    is_open: Bool[np.ndarray, "h w"],
    colors: Float[np.ndarray, "h w 3"],
    config: ColourConfig,
) -> bool:
    """Return whether one image shows that something of no class continues an object in its colour.

    Args:
        estimate: The object.
        surface: Its surface in the world frame.
        points: World points of the raised pixels [m].
        raised: Pixels above the support.
        is_open: Those of them that belong to no object.
        colors: CIE Lab.
        config: What continues an object.
    """
    distance = np.full(raised.shape, np.inf)
    distance[raised] = surface.distance(points, config.reach)
    touching = is_open & (distance < config.contact)
    if not touching.any():
        return False
    own = distance < config.own
    at_contact = KDTree(points[touching[raised]])
    own[own] = np.isfinite(at_contact.query(points[own[raised]], distance_upper_bound=config.reach)[0])
    if own.sum() < config.min_pixels:
        return False
    color = np.median(colors[own], axis=0)
    difference = colors - color
    chroma = max(config.chroma, config.relative_chroma * float(np.hypot(*color[1:])))
    same = np.linalg.norm(difference[..., 1:], axis=-1) < chroma
    same &= np.abs(difference[..., 0]) < config.lightness
    # A speck of the same colour between does not connect.
    rest = cv2.morphologyEx((is_open & same).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(rest, connectivity=4)
    connected = np.isin(labels, np.setdiff1d(labels[touching & (rest > 0)], [0]))
    far = connected & ~np.isfinite(distance)
    far[raised] &= _is_aside(estimate, points, config)
    far[far] = np.isfinite(surface.distance(points[far[raised]], config.near))
    return int(far.sum()) >= config.min_pixels


def _is_aside(
    estimate: ObjectEstimate, points: Float[np.ndarray, "n 3"], config: ColourConfig
) -> Bool[np.ndarray, "n"]:
    """Return which world points are farther from an object's axis than its own surface may be."""
    local = transform_points(invert(estimate.T_world_object), points)
    return np.linalg.norm(local[:, :2], axis=1) > estimate.radius + config.aside
