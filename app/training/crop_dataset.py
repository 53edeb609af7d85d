"""Labelled crops from rendered images: the data set of the class and yaw networks.

Masks are the true ones, perturbed like those of the detector: slightly too large, ragged, truncated, with
missing parts or parts of neighbours. The label of a mask is that of the object which covers most of it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from app.training.files import load_arrays, packed_arrays
from app.training.shards import Progress as Progress
from perception.detection.crops import CHANNELS, CONTEXT, SIDE, crop, frame_geometry
from perception.detection.geometry import bounding_window, heading_angle, points_of
from perception.types import CATEGORIES, OTHER, SupportPlane

if TYPE_CHECKING:
    from sim_assets.datasets.labels import InstanceLabel, LabelledImage  # perception alone runs without it

logger = logging.getLogger(__name__)
IndexOf = Callable[["InstanceLabel | None"], "int | None"]
Split = Literal["train", "test"]

PURITY = 0.8  # smallest share of a mask's object pixels that belong to the object it is labelled with
COVERAGE = 0.4  # smallest share of that object's visible pixels inside the mask
AROUND = 0.35  # share of the images with a false mask on things around the table, if there are any
BODY = 0.25  # diameter of the discs that fill a mug's body, relative to the square root of its mask's area
HANDLE_PART = 0.03  # least share of a mask that is handle, if it has one
MIN_PIXELS = 150  # smallest number of visible pixels of an object with a mask


@dataclass(frozen=True)
class LabelledCrops:
    """Crops with ground truth.

    Attributes:
        images: (n, SIDE, SIDE, 6) as in ``perception.detection.crops.Crop``.
        context: (n, 2) as in ``perception.detection.crops.Crop``.
        label: (n,) index into CATEGORIES, OTHER for distractors and background.
        yaw: (n,) direction of a mug's handle (object +x), or of the axis of what lies from base to top,
            relative to the crop's heading, in radians; 0 for others.
        handle: (n,) share of a mug's visible points that lie on its handle; 0 for others.
    """

    images: UInt8[np.ndarray, "n side side 6"]
    context: Float[np.ndarray, "n 2"]
    label: Int[np.ndarray, "n"]
    yaw: Float[np.ndarray, "n"]
    handle: Float[np.ndarray, "n"]

    def __len__(self) -> int:
        return len(self.label)

    def subset(self, rows: Bool[np.ndarray, "n"] | Int[np.ndarray, "m"]) -> LabelledCrops:
        """Return the crops of the given rows."""
        return LabelledCrops(**{name: getattr(self, name)[rows] for name in _COLUMNS})

    def packed(self) -> bytes:
        """Return the arrays as the content of an npz file."""
        return packed_arrays(self, _COLUMNS)

    @staticmethod
    def load(path: Path) -> LabelledCrops:
        """Read a file of ``packed`` arrays; raises PerceptionError for a damaged file."""
        return LabelledCrops(**load_arrays(path, _COLUMNS, "labelled crops"))

    @staticmethod
    def concatenate(parts: Sequence[LabelledCrops]) -> LabelledCrops:
        """Concatenate at least one part."""
        return LabelledCrops(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in _COLUMNS})


_COLUMNS = ("images", "context", "label", "yaw", "handle")


def label_crops(
    image: LabelledImage,
    plane: SupportPlane,
    masks: Sequence[Bool[np.ndarray, "h w"]],
    index_of: IndexOf | None = None,
) -> LabelledCrops:
    """Return the crops of the masks in one image, without those that lack depth or a clear label.

    Args:
        image: Rendered image with ground truth.
        plane: Support plane as perceived.
        masks: Pixels of each crop's instance.
        index_of: Label of an item, or of the background (None); None for what is not to be learned. By
            default the class of upright objects.
    """
    index_of = index_of or class_index
    frame, truth = image.frame, image.instances
    geometry = frame_geometry(frame, plane)
    size = np.bincount(truth[truth >= 0], minlength=len(image.labels))
    masks = [mask for mask in masks if geometry.has_depth(mask)]
    rows = []
    for mask in masks:
        inside = np.bincount(truth[mask & (truth >= 0)], minlength=len(image.labels))
        index = int(inside.argmax()) if inside.sum() else -1
        label = _label_of(image, mask, inside, size, index_of)
        if label is None:
            continue
        piece = crop(frame, mask, plane, geometry)
        yaw, handle = 0.0, 0.0
        thing = None if label == index_of(None) else image.labels[index]
        if thing is not None and (thing.category == "mug" or thing.resting == "lying"):
            yaw = (thing.direction - heading_angle(piece.heading, plane) + np.pi) % (2 * np.pi) - np.pi
        if thing is not None and (thing.category, thing.resting) == ("mug", "upright"):
            handle = handle_share(points_of(frame, truth == index, geometry.depth), thing.T_world_object)
        rows.append((piece.image, piece.context, label, yaw, handle))

    columns = zip(_COLUMNS, _DTYPES, zip(*rows) if rows else _NO_ROWS)
    return LabelledCrops(**{name: np.array(c, dtype=t) for name, t, c in columns})


_DTYPES = (np.uint8, np.float32, np.int64, np.float32, np.float32)  # of the columns
_NO_ROWS = (np.zeros((0, SIDE, SIDE, CHANNELS)), np.zeros((0, CONTEXT)), *[np.zeros(0)] * 3)


def _label_of(
    image: LabelledImage,
    mask: Bool[np.ndarray, "h w"],
    inside: Int[np.ndarray, "k"],
    size: Int[np.ndarray, "k"],
    index_of: IndexOf,
) -> int | None:
    """Return the label of a mask, that of a distractor for the background, None if it is ambiguous."""
    if inside.sum() < 0.3 * mask.sum():
        return index_of(None)  # table, wall or background
    index = int(inside.argmax())
    if inside[index] < PURITY * inside.sum():
        return None
    is_object = image.labels[index].category is not None
    return index_of(image.labels[index]) if not is_object or inside[index] >= COVERAGE * size[index] else None


def class_index(item: InstanceLabel | None) -> int | None:
    """Return the index of an upright object's class, OTHER for all but objects; None for other poses."""
    if item is None:
        return OTHER
    if item.ignored:
        return None
    return OTHER if item.category is None else CATEGORIES.index(item.category)


def handle_share(points: Float[np.ndarray, "n 3"], T_world_object: Float[np.ndarray, "4 4"]) -> float:
    """Return the share of a mug's visible points that lie on its handle.

    The body's radius is estimated from the points more than 60 degrees from +x; handle points are more than 5
    mm outside it and within 50 degrees of +x. Without enough body points the share is 0.

    Args:
        points: World points of the mug, in metres.
        T_world_object: Pose of the mug, handle along +x.
    """
    if len(points) == 0:
        return 0.0
    local = (points - T_world_object[:3, 3]) @ T_world_object[:3, :3]
    radius, angle = np.hypot(local[:, 0], local[:, 1]), np.abs(np.arctan2(local[:, 1], local[:, 0]))
    body = radius[angle > np.radians(60)]
    if len(body) < 20:
        return 0.0
    return float(((radius > np.percentile(body, 99) + 0.005) & (angle < np.radians(50))).mean())


def perturb_masks(
    image: LabelledImage, rng: np.random.Generator, min_pixels: int = 2 * MIN_PIXELS, astray: float = 0.0
) -> list[Bool[np.ndarray, "h w"]]:
    """Return the true masks with errors like those of the detector, and sometimes one on something else.

    Args:
        image: Rendered image with ground truth.
        rng: Source of randomness.
        min_pixels: Smallest mask.
        astray: Share of the masks with a part of a neighbour, and of those with a missing part.
    """
    masks = []
    size = np.bincount(image.instances[image.instances >= 0], minlength=len(image.labels))
    for index in np.flatnonzero(size >= min_pixels):
        true = image.instances == index
        window = bounding_window(true, 8)
        part = true[window].astype(np.float32)
        rough = cv2.GaussianBlur(rng.standard_normal(part.shape, dtype=np.float32), (0, 0), 2.0)
        soft = cv2.GaussianBlur(part, (0, 0), rng.uniform(0.8, 2.5))
        ragged = (soft + rng.uniform(0, 1.0) * rough > rng.uniform(0.25, 0.5)) & (soft > 0.05)
        if rng.random() < (0.5 if image.labels[index].category is None else 0.08):
            ragged = _truncate(ragged, rng)
        mask = np.zeros_like(true)
        mask[window] = ragged
        if astray > 0 and rng.random() < astray:
            mask |= _part_of_neighbour(image, int(index), window, rng)
        if astray > 0 and rng.random() < astray:
            mask = _remove_part(mask, rng)
        masks.append(mask)
    if rng.random() < 0.15:
        masks.append(_ellipse(image.instances.shape, None, rng) & (image.instances < 0))
    if image.surroundings is not None and rng.random() < AROUND:
        masks.append(_ellipse(image.instances.shape, image.surroundings, rng) & image.surroundings)
    return [mask for mask in masks if mask.sum() >= min_pixels]


def bodies_of_mugs(
    image: LabelledImage, masks: Sequence[Bool[np.ndarray, "h w"]]
) -> list[Bool[np.ndarray, "h w"]]:
    """Return the masks of upright mugs without their thin parts, where these are more than ``HANDLE_PART``.

    So are those of the detector where a handle is hardly measured, as by active stereo, though it is in view.
    """
    bodies = []
    for mask in masks:
        inside = image.instances[mask & (image.instances >= 0)]
        label = image.labels[int(np.bincount(inside).argmax())] if len(inside) else None
        if label is None or label.ignored or label.category != "mug":
            continue
        side = 2 * round(BODY * float(np.sqrt(mask.sum())) / 2) + 1
        window = bounding_window(mask, side)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        body = np.zeros_like(mask)
        body[window] = cv2.morphologyEx(mask[window].astype(np.uint8), cv2.MORPH_OPEN, disc) > 0
        if 0 < body.sum() < (1 - HANDLE_PART) * mask.sum():
            bodies.append(body)
    return bodies


def _ellipse(
    shape: tuple[int, ...], within: Bool[np.ndarray, "h w"] | None, rng: np.random.Generator
) -> Bool[np.ndarray, "h w"]:
    """Return a random ellipse, centred on one of the pixels ``within`` if there are any."""
    height, width = shape
    centre = (int(rng.integers(width)), int(rng.integers(height)))
    if within is not None and within.any():
        centre = divmod(int(rng.choice(np.flatnonzero(within))), width)[::-1]
    patch = np.zeros((height, width), np.uint8)
    axes = (int(rng.integers(10, 60)), int(rng.integers(10, 60)))
    cv2.ellipse(patch, centre, axes, rng.uniform(0, 180), 0, 360, 1, -1)
    return patch.astype(bool)


def _part_of_neighbour(
    image: LabelledImage, index: int, window: tuple[slice, slice], rng: np.random.Generator
) -> Bool[np.ndarray, "h w"]:
    """Return a disc on another object within half the size of the window; empty if there is none."""
    height, width = image.instances.shape
    rows, columns = window
    reach = max(rows.stop - rows.start, columns.stop - columns.start) // 2
    near = np.zeros((height, width), bool)
    top, left = max(rows.start - reach, 0), max(columns.start - reach, 0)
    near[top : rows.stop + reach, left : columns.stop + reach] = True
    near &= (image.instances >= 0) & (image.instances != index)
    v, u = np.nonzero(near)
    if not len(v):
        return near
    k = rng.integers(len(v))
    disc = np.zeros((height, width), np.uint8)
    cv2.circle(disc, (int(u[k]), int(v[k])), int(rng.integers(4, max(6, reach))), 1, -1)
    return near & (disc > 0) & (image.instances == image.instances[v[k], u[k]])


def _remove_part(mask: Bool[np.ndarray, "h w"], rng: np.random.Generator) -> Bool[np.ndarray, "h w"]:
    """Return the mask without a disc around one of its outer pixels, such as a mug's handle."""
    v, u = np.nonzero(mask)
    if not len(v):
        return mask
    away = np.hypot(v - v.mean(), u - u.mean())
    far = np.flatnonzero(away >= np.quantile(away, rng.uniform(0.7, 0.99)))
    k = int(rng.choice(far))
    radius = rng.uniform(0.1, 0.5) * max(np.ptp(v), np.ptp(u))
    gone = np.hypot(v - v[k], u - u[k]) < radius
    result = mask.copy()
    result[v[gone], u[gone]] = False
    return result


def _truncate(mask: Bool[np.ndarray, "h w"], rng: np.random.Generator) -> Bool[np.ndarray, "h w"]:
    """Return the part of the mask on one side of a random line through it."""
    v, u = np.nonzero(mask)
    if not len(v):
        return mask
    angle = rng.uniform(-np.pi, np.pi)
    side = np.cos(angle) * u + np.sin(angle) * v
    kept = side > np.quantile(side, rng.uniform(0.1, 0.5))
    result = np.zeros_like(mask)
    result[v[kept], u[kept]] = True
    return result


def perturb_plane(plane: SupportPlane, rng: np.random.Generator) -> SupportPlane:
    """Return the plane with the error of a fit: 1.5 mm and 0.3 degrees (standard deviations)."""
    normal = plane.normal + np.append(rng.normal(0, np.radians(0.3), 2), 0.0)
    return SupportPlane(normal / np.linalg.norm(normal), float(plane.offset + rng.normal(0, 0.0015)))
