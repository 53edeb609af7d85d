"""Masks of the landmarks in a frame without detections: rendered from the map, decided by measured depth.

A pixel belongs to the landmark that is rendered there, or near there, if it measures a point above the plane
at the landmark's depth. The outlines are those of the measurement: outlines of the rendering would agree with
any prediction of the camera pose, and tracking would drift. Points above the plane beside all rendered masks
are unexplained: something that the map lacks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from perception.detection.geometry import linear_in_depth
from perception.slam.association import RenderedMasks
from perception.slam.labelled_frame import BACKGROUND, MAX_LABELS, LabelImage, LabelledFrame
from perception.types import RgbdFrame, SupportPlane

_UNKNOWN = MAX_LABELS  # label of pixels that belong neither to a landmark nor to the background


@dataclass(frozen=True)
class MaskTrackingConfig:
    """Which pixels belong to a landmark, and which are unexplained.

    Attributes:
        depth_margin: Depth difference from the rendered surface up to which a pixel belongs to its landmark,
            in metres; to it add two standard deviations of the rendered depth.
        growth: Distance up to which a landmark's pixels can lie beside its rendered mask, in image pixels.
        min_height: Height above the plane from which a pixel can belong to a landmark, in metres. Lower ones
            near a rendered mask belong to nothing: noise does not let them be told from the plane.
        unexplained_height: Range of heights above the plane of unexplained points, in metres.
        image_width: Width to which larger images are subsampled, in pixels.
        min_pixels: Least number of measured image pixels of a visible landmark.
    """

    depth_margin: float = 0.03
    growth: int = 12
    min_height: float = 0.006
    unexplained_height: tuple[float, float] = (0.02, 0.4)
    image_width: int = 320
    min_pixels: int = 120


@dataclass(frozen=True)
class TrackedMasks:
    """Masks of the landmarks in one frame.

    Attributes:
        view: The frame with one label for each visible landmark, and without detections.
        explained: Share of the measured pixels in each landmark's rendered mask that belong to it.
        n_unexplained: Number of image pixels that measure something that the map lacks.
    """

    view: LabelledFrame
    explained: Mapping[int, float]
    n_unexplained: int


def track_masks(
    number: int,
    frame: RgbdFrame,
    rendered: RenderedMasks,
    plane: SupportPlane,
    config: MaskTrackingConfig = MaskTrackingConfig(),
) -> TrackedMasks:
    """Return the masks of the landmarks that a frame shows.

    Args:
        number: Index of the frame in the sequence.
        frame: Images with the predicted camera pose.
        rendered: Masks of the map, rendered from that pose.
        plane: Support plane in the world frame.
        config: Thresholds.
    """
    pitch = max(1, round(frame.depth.shape[1] / config.image_width))
    depth, height = _subsampled(frame, plane, pitch)
    at = _Rendering.of(rendered, pitch, depth.shape, config.growth)
    measured = depth > 0
    raised = measured & (height > config.min_height)
    nearest, farthest = at.depth_range[at.grown, 0], at.depth_range[at.grown, 1]
    near_surface = np.abs(depth - at.depth) < config.depth_margin + 2 * at.sigma
    near_landmark = (depth > nearest - config.depth_margin) & (depth < farthest + config.depth_margin)
    belongs = raised & np.where(at.labels != BACKGROUND, near_surface, near_landmark)
    labels = np.where(belongs, at.grown, BACKGROUND).astype(np.uint8)
    contact = measured & ~raised & (height > -config.min_height) & (at.grown != BACKGROUND)
    labels[contact] = _UNKNOWN
    n_measured = np.bincount(at.labels[measured], minlength=MAX_LABELS + 1)
    n_own = np.bincount(at.labels[belongs], minlength=MAX_LABELS + 1)
    present = np.bincount(labels.ravel(), minlength=MAX_LABELS + 1) > 0
    judged = [label for label in at.landmark_of if n_measured[label] * pitch**2 >= config.min_pixels]
    low, high = config.unexplained_height
    unexplained = measured & (height > low) & (height < high) & (at.grown == BACKGROUND)
    landmark_of = {label: at.landmark_of[label] for label in judged if present[label]}
    return TrackedMasks(
        LabelledFrame(number, frame, (), _enlarged(labels, pitch, frame.depth.shape), landmark_of),
        {at.landmark_of[label]: float(n_own[label] / n_measured[label]) for label in judged},
        pitch**2 * int(np.count_nonzero(unexplained)),
    )


@dataclass(frozen=True)
class _Rendering:
    """Rendered masks on a finer grid, as labels.

    Attributes:
        landmark_of: Landmark id of each label.
        labels: Label of each pixel.
        grown: The same with the masks grown into the background; ``_UNKNOWN`` where two of them meet.
        depth: Rendered depth, in metres; undefined in the background.
        sigma: Its standard deviation, in metres.
        depth_range: Smallest and largest rendered depth of each label, in metres.
    """

    landmark_of: Mapping[int, int]
    labels: LabelImage
    grown: LabelImage
    depth: Float[np.ndarray, "_h _w"]
    sigma: Float[np.ndarray, "_h _w"]
    depth_range: Float[np.ndarray, "l 2"]

    @staticmethod
    def of(rendered: RenderedMasks, pitch: int, shape: tuple[int, ...], growth: int) -> _Rendering:
        """Resample the rendered masks to an image of a shape whose pixels are ``pitch`` image pixels wide."""
        ids = rendered.landmark_ids
        shown = [int(id) for id in np.unique(ids[ids >= 0])][: MAX_LABELS - 1]  # the last label is _UNKNOWN
        label_of = np.zeros(max(shown, default=0) + 2, np.uint8)  # index -1, no landmark, is the last entry
        label_of[shown] = np.arange(1, len(shown) + 1)
        coarse = label_of[ids]
        depth_range = np.zeros((MAX_LABELS + 1, 2))
        for label in range(1, len(shown) + 1):
            own = rendered.depth[coarse == label]
            depth_range[label] = own.min(), own.max()
        factor = rendered.pitch // pitch
        labels, depth, sigma = (
            _enlarged(image, factor, shape) for image in (coarse, rendered.depth, rendered.sigma)
        )
        landmark_of = dict(enumerate(shown, start=1))
        return _Rendering(landmark_of, labels, _grown(labels, growth // pitch), depth, sigma, depth_range)


def _subsampled(
    frame: RgbdFrame, plane: SupportPlane, pitch: int
) -> tuple[Float[np.ndarray, "_h _w"], Float[np.ndarray, "_h _w"]]:
    """Return depth and height above the plane of every ``pitch``-th pixel of every ``pitch``-th row."""
    depth = frame.depth[::pitch, ::pitch]
    slope, constant = linear_in_depth(frame, plane.normal)
    return depth, depth * slope[::pitch, ::pitch] + np.float32(constant - plane.offset)


def _grown(labels: LabelImage, radius: int) -> LabelImage:
    """Return the labels with each mask grown by a radius into the background, ``_UNKNOWN`` where two meet."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
    largest = cv2.dilate(labels, disc)
    smallest = cv2.erode(np.where(labels == BACKGROUND, MAX_LABELS, labels).astype(np.uint8), disc)
    beside = np.where(largest == smallest, largest, np.where(largest == BACKGROUND, BACKGROUND, _UNKNOWN))
    return np.where(labels != BACKGROUND, labels, beside).astype(np.uint8)


def _enlarged(image: np.ndarray, factor: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return an image whose pixels are repeated along both axes, cropped to a shape."""
    return image.repeat(factor, axis=0).repeat(factor, axis=1)[: shape[0], : shape[1]]
