"""Training patches of the scene network: cut out of images with ground truth, and varied."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from perception.detection.working_view import WorkingView, working_view
from perception.types import RgbdFrame, SupportPlane

UNJUDGED = 255  # in ``things``: pixels that may be foreground or background


@dataclass(frozen=True)
class LabelledScene:
    """One image with ground truth at the network's resolution.

    Attributes:
        frame: Result of ``working_view.downscale``.
        things: (h, w) 1 + index of the object or distractor at each pixel, 0 for background, UNJUDGED where
            both are right: furniture around the table is refused by its place.
        label: (k,) class of each object, OTHER for distractors, -1 if it is not to be learned.
        foot: (k, 3) footprint of each object: where its axis meets the table, in metres.
        plane: The table's plane.
    """

    frame: RgbdFrame
    things: UInt8[np.ndarray, "h w"]
    label: Int[np.ndarray, "k"]
    foot: Float[np.ndarray, "k 3"]
    plane: SupportPlane


@dataclass(frozen=True)
class TrainingPatch:
    """A square patch of an image: network input and targets.

    Attributes:
        channels: (side, side, 8) input channels (``WorkingView.channels``).
        things: (side, side) 1 + index of the object or distractor at each pixel, 0 for background, UNJUDGED
            where both are right.
        label: (side/2, side/2) class of every second pixel, -1 for background.
        offset: (side/2, side/2, 2) offset to the footprint in units of the pixel's size.
        pixel: (side/2, side/2) size of a pixel, in metres.
        weight: (side/2, side/2) weight in the losses, larger for small objects, 0 for background.
    """

    channels: Float[np.ndarray, "s s 8"]
    things: UInt8[np.ndarray, "s s"]
    label: np.ndarray
    offset: np.ndarray
    pixel: np.ndarray
    weight: np.ndarray


def sample_patch(scene: LabelledScene, side: int, rng: np.random.Generator) -> TrainingPatch:
    """Return a random patch of an image: possibly mirrored, with varied colours, plane and missing depth.

    Args:
        scene: The image.
        side: Side of the patch in pixels, a multiple of 32; smaller images are used whole.
        rng: Random generator.
    """
    part = tuple(_window(length, side, rng) for length in scene.things.shape)
    things = scene.things[part]
    items = np.where(things == UNJUDGED, 0, things)
    view = working_view(
        _with_holes(_part_of(scene.frame, part), items, rng), _perturb_plane(scene.plane, rng)
    )
    things, channels, pixel = np.rot90(things, view.turns), view.channels, view.pixel
    offset = _offsets(view, np.rot90(items, view.turns), scene.foot)
    if rng.random() < 0.5:
        channels, things, pixel = channels[:, ::-1], things[:, ::-1], pixel[:, ::-1]
        offset = offset[:, ::-1] * np.array([-1, 1], np.float32)
    channels = np.dstack([vary_colours(channels[..., :3], rng), channels[..., 3:]])
    coarse = np.where(things == UNJUDGED, 0, things)[::2, ::2]
    label = np.where(coarse > 0, scene.label[np.maximum(coarse, 1) - 1].astype(np.int64), -1)
    sizes = np.bincount(coarse.ravel(), minlength=256).astype(np.float32)
    weight = np.where(coarse > 0, 1 / np.sqrt(np.maximum(sizes[coarse], 20)), 0).astype(np.float32)
    return TrainingPatch(
        np.ascontiguousarray(channels), np.ascontiguousarray(things), label, offset[::2, ::2],
        pixel[::2, ::2], weight,
    )  # fmt: skip


def _part_of(frame: RgbdFrame, part: tuple[slice, ...]) -> RgbdFrame:
    """Return the cropped image with the principal point shifted accordingly."""
    k, (rows, columns) = frame.intrinsics, part
    height, width = frame.depth[part].shape
    camera = replace(k, width=width, height=height, cx=k.cx - columns.start, cy=k.cy - rows.start)
    return RgbdFrame(frame.time, frame.rgb[part], frame.depth[part], camera, frame.T_world_camera)


def _window(length: int, side: int, rng: np.random.Generator) -> slice:
    start = 2 * int(rng.integers(0, (length - side) // 2 + 1)) if length > side else 0
    return slice(start, start + side)


def _offsets(
    view: WorkingView, things: np.ndarray, foot: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "h w 2"]:
    """Return the offset from each pixel to its object's footprint, in pixels; undefined for background."""
    footprints = (foot @ view.axes.T).astype(np.float32)
    target = footprints[np.maximum(things.astype(int), 1) - 1] - view.plan
    return np.clip(target / view.pixel[..., None], -500, 500)


def _perturb_plane(plane: SupportPlane, rng: np.random.Generator) -> SupportPlane:
    """Return the table's plane with the error of a fit."""
    normal = plane.normal + np.append(rng.normal(0, np.radians(0.3), 2), 0.0)
    return SupportPlane(normal / np.linalg.norm(normal), float(plane.offset + rng.normal(0, 0.0015)))


def _with_holes(frame: RgbdFrame, things: np.ndarray, rng: np.random.Generator) -> RgbdFrame:
    """Remove depth in patches, as on specular, dark or transparent surfaces."""
    if rng.random() < 0.5:
        return frame
    depth = frame.depth.copy()
    shape = depth.shape
    holes = np.zeros(shape, np.uint8)
    v, u = np.nonzero(things)
    for _ in range(rng.integers(1, 6)):
        on_object = len(v) > 0 and rng.random() < 0.8
        k = rng.integers(len(v)) if on_object else 0
        centre = (
            (int(u[k]), int(v[k]))
            if on_object
            else (int(rng.integers(shape[1])), int(rng.integers(shape[0])))
        )
        axes = (int(rng.integers(2, 16)), int(rng.integers(2, 16)))
        cv2.ellipse(holes, centre, axes, rng.uniform(0, 180), 0, 360, 1, -1)
    patchy = cv2.resize(rng.random((shape[0] // 3 + 1, shape[1] // 3 + 1)), shape[::-1])
    depth[(holes > 0) & (patchy < rng.uniform(0.3, 1.0))] = 0
    return replace(frame, depth=depth)


def vary_colours(rgb: Float[np.ndarray, "h w 3"], rng: np.random.Generator) -> Float[np.ndarray, "h w 3"]:
    """Vary colours (in -0.5..0.5), so that the network relies on shape more than on colour."""
    image = rgb + 0.5
    if rng.random() < 0.1:
        image = image[..., rng.permutation(3)]
    if rng.random() < 0.1:
        image = np.repeat(image.mean(-1, keepdims=True), 3, axis=-1)
    image = np.power(np.clip(image, 0, 1), rng.uniform(0.5, 1.5), dtype=np.float32)
    image = image * rng.uniform(0.6, 1.8) * rng.uniform(0.85, 1.15, 3).astype(np.float32)
    if rng.random() < 0.4:  # a shading gradient
        height, width = image.shape[:2]
        corners = rng.uniform(0.6, 1.4, (2, 2)).astype(np.float32)
        image = image * cv2.resize(corners, (width, height))[..., None]
    if rng.random() < 0.3:
        image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), rng.uniform(0.4, 1.2))
    noise = rng.standard_normal(image.shape, dtype=np.float32) * (rng.uniform(0, 0.05) * (rng.random() < 0.5))
    return (np.clip(image + rng.uniform(-0.1, 0.1) + noise, 0, 1) - 0.5).astype(np.float32)
