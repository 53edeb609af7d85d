"""Things of no class in a task: found beside the object map, reported with a picture each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from manipulation.obstacles import box_obstacles
from manipulation.robot import ArmDescription
from manipulation.self_view import fixed_bounds
from manipulation.types import Box
from perception.detection.geometry import points_of, project
from perception.inference.depth_votes import Region
from perception.obstacles.find import find_obstacles
from perception.obstacles.obstacle import PerceivedObstacle
from perception.obstacles.unexplained import ExplanationConfig, KnownGeometry
from perception.pipeline import Detections
from perception.support.surface import SupportSurface
from perception.types import ObjectEstimate, RgbdFrame

ABOVE_BOX = 0.25  # [m] over its walls: what is packed rises above them
BOX_MARGIN = 0.015  # [m] from the box, within which points are measurements of it
BOX_SHARE = 0.5  # of the points of what shows the box
WALL_MARGIN = 0.006  # [m] from a wall of the box, within which points are measurements of it
_PADDING = 12  # pixels around a thing in its picture


def obstacles_beside(
    objects: Sequence[ObjectEstimate],
    frames: Sequence[RgbdFrame],
    detections: Detections,
    box: Box | None,
    arm: ArmDescription,
) -> tuple[PerceivedObstacle, ...]:
    """Return what depth shows on the table besides the objects, the box and the arm's own base."""
    surface = table_of(detections)
    known = np.concatenate([fixed_bounds(arm), known_bounds(box)])
    return tuple(find_obstacles(frames, detections.per_frame, objects, surface, known))


def table_of(detections: Detections) -> SupportSurface:
    """Return the surface that the objects of a task stand on."""
    return detections.surfaces[0] if detections.surfaces else SupportSurface(detections.plane)


def obstacles_during(
    objects: Sequence[ObjectEstimate],
    frames: Sequence[RgbdFrame],
    surface: SupportSurface,
    box: Box | None,
    arm: ArmDescription,
) -> tuple[PerceivedObstacle, ...]:
    """Return what images during a run show on the table besides the objects, the box and the arm's base.

    Whatever is in or above the box counts as known: what was packed there may have settled a little aside.
    """
    known = np.concatenate([fixed_bounds(arm), filled_bounds(box)])
    masks = [()] * len(frames)
    return tuple(find_obstacles(frames, masks, objects, surface, known))


def unexplained_during(
    points: Float[np.ndarray, "n 3"],
    objects: Sequence[ObjectEstimate],
    obstacles: Sequence[PerceivedObstacle],
    surface: SupportSurface,
    box: Box | None,
) -> Float[np.ndarray, "_m 3"]:
    """Return the world points [m] above the table that are measurements of nothing known.

    Args:
        points: Measured points without flying pixels and without the robot.
        objects: Objects where they are.
        obstacles: Known things of no class.
        surface: Surface of the table.
        box: The box; whatever is in or above it counts as known.
    """
    margin = ExplanationConfig().margin
    known = KnownGeometry.of(objects, filled_bounds(box))
    open_ = points[surface.plane.height_above(points) > margin]
    open_ = open_[~known.explains(open_, margin)]
    for obstacle in obstacles:
        open_ = open_[~obstacle.explains(open_, margin)]
    return open_


def beside_box(
    bounds: Float[np.ndarray, "k 2 3"], frames: Sequence[RgbdFrame], detections: Detections
) -> Detections:
    """Return the detections and candidates that do not show the box, of which the bounds [m] are known."""
    known = KnownGeometry.of((), bounds)

    def shows_box(frame: RgbdFrame, mask: Bool[np.ndarray, "h w"]) -> bool:
        points = points_of(frame, mask)
        return len(points) > 0 and bool(known.explains(points, BOX_MARGIN).mean() > BOX_SHARE)

    return replace(
        detections,
        per_frame=tuple(
            tuple(found for found in row if not shows_box(frame, found.mask))
            for frame, row in zip(frames, detections.per_frame, strict=True)
        ),
        left_out=tuple(c for c in detections.left_out if not shows_box(frames[c.frame], c.mask)),
    )


def known_bounds(box: Box | None) -> Float[np.ndarray, "k 2 3"]:
    """Return the corners of floor and walls of the box in metres; none without a box."""
    parts = box_obstacles(box) if box is not None else ()
    corners = [
        [np.subtract(part.center, part.half_size), np.add(part.center, part.half_size)] for part in parts
    ]
    return np.array(corners).reshape(-1, 2, 3)


def box_interior(box: Box) -> Region:
    """Return the ranges of x and y [m] between the walls, without what may be a measurement of them."""
    half = np.array(box.size[:2]) / 2 - WALL_MARGIN
    low, high = np.array(box.center) - half, np.array(box.center) + half
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def filled_bounds(box: Box | None) -> Float[np.ndarray, "k 2 3"]:
    """Return the corners of the box with what is in it or rises above it, in metres; none without a box."""
    corners = known_bounds(box)
    if not len(corners):
        return corners
    above = np.array([0.0, 0.0, ABOVE_BOX])
    return np.array([[corners[:, 0].min(axis=0), corners[:, 1].max(axis=0) + above]])


def bounds_of(objects: Sequence[ObjectEstimate]) -> Float[np.ndarray, "k 2 3"]:
    """Return the lower and upper corners of the bounding boxes of objects in metres."""
    vertices = [estimate.mesh_world.vertices for estimate in objects]
    return np.array([[v.min(axis=0), v.max(axis=0)] for v in vertices]).reshape(-1, 2, 3)


@dataclass(frozen=True)
class Portrait:
    """A thing in the image that shows it best.

    Attributes:
        frame: Index of the image.
        window: Rows and columns that show it.
    """

    frame: int
    window: tuple[slice, slice]

    def picture(self, frames: Sequence[RgbdFrame]) -> UInt8[np.ndarray, "h w 3"]:
        """Return the part of the image that shows the thing."""
        return np.ascontiguousarray(frames[self.frame].rgb[self.window])


def portrait_of(obstacle: PerceivedObstacle, frames: Sequence[RgbdFrame]) -> Portrait | None:
    """Return where a thing is shown completely and largest, or largest if cut; None if no image shows it."""
    best, found = 0.0, None
    for index, frame in enumerate(frames):
        pixels, depth = project(frame, np.concatenate(obstacle.pieces))
        size = np.array([frame.intrinsics.width, frame.intrinsics.height])
        if depth.min() <= 0:
            continue
        low = np.clip(pixels.min(axis=0) - _PADDING, 0, size)
        high = np.clip(pixels.max(axis=0) + _PADDING, 0, size)
        whole = (pixels >= 0).all() and (pixels < size).all()
        shown = float((high - low).prod()) * (1.0 if whole else 0.2)
        if shown > best and (high > low).all():
            window = (slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0])))
            best, found = shown, Portrait(index, window)
    return found


def picture_name(obstacle: PerceivedObstacle) -> str:
    """Return the path of a thing's picture in a run folder."""
    return f"pictures/{obstacle.name}.png"


def obstacle_rows(
    obstacles: Sequence[PerceivedObstacle], frames: Sequence[RgbdFrame]
) -> list[dict[str, Any]]:
    """Return for each thing its name, centre and size [m], and the image and pixels that show it best."""
    rows = []
    for obstacle in obstacles:
        low, high = obstacle.bounds
        row: dict[str, Any] = {
            "name": obstacle.name,
            "center": np.round((low + high) / 2, 4).tolist(),
            "size": np.round(high - low, 4).tolist(),
        }
        portrait = portrait_of(obstacle, frames)
        if portrait is not None:
            rows_, columns = portrait.window
            box = [columns.start, rows_.start, columns.stop - columns.start, rows_.stop - rows_.start]
            row |= {"image": portrait.frame, "box": box}
        rows.append(row)
    return rows


def obstacle_note(obstacle: PerceivedObstacle) -> str:
    """Return a line about a thing for the warnings of a report."""
    low, high = obstacle.bounds
    x, y = (low + high)[:2] / 2
    size = " x ".join(f"{100 * length:.0f}" for length in high - low)
    return f"{obstacle.name}: a thing of no class, {size} cm, at ({x:.2f}, {y:.2f}) m is avoided"
