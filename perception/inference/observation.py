"""Pixels of a fit: crops around one object's masks, classified as object or background.

Pixels in a ring outside the mask are measurements too: the ray must miss the object there, so their target
is the escape depth. Pixels near the mask's border, where masks are least reliable, depth holes and pixels
covered by something else are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse

from perception.errors import InvalidInputError
from perception.geometry import invert, transform_points
from perception.rendering.pyramid import pyramid_operator
from perception.rendering.renderer import RayBundle
from perception.types import Category, ObjectEstimate, RgbdFrame

SAMPLING_MARGIN = 0.015  # [m] added to an object's bounding sphere, so that the renderer's rays leave it
RAY_SAMPLES = (24, 192)  # fewest and most samples of the renderer on a ray


def sampling_radius(bounding_radius: float) -> float:
    """Return half of the depth range [m] about an object's centre in which rays are sampled."""
    return bounding_radius + SAMPLING_MARGIN


def ray_samples(radius: float, step: float) -> int:
    """Return the number of samples on a ray through a depth range of +-``radius`` [m] at ``step`` [m]."""
    return int(np.clip(round(2 * radius / step), *RAY_SAMPLES))


@dataclass(frozen=True)
class ObjectObservation:
    """One object in one view.

    Attributes:
        frame: Image with known camera pose.
        mask: (H, W) pixels of the object.
        ignore: (H, W) pixels without information about the object, such as occluded ones, or None.
        yaw_probabilities: (B,) yaw distribution as in ObjectDetection; empty if unknown.
    """

    frame: RgbdFrame
    mask: Bool[np.ndarray, "h w"]
    ignore: Bool[np.ndarray, "h w"] | None = None
    yaw_probabilities: Float[np.ndarray, "b"] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.frame.T_world_camera is None:
            raise InvalidInputError(
                "a frame without camera pose cannot be fitted; track or calibrate it first"
            )
        if self.mask.shape != self.frame.depth.shape:
            raise InvalidInputError(f"mask is {self.mask.shape}, its image {self.frame.depth.shape}")

    @property
    def T_world_camera(self) -> Float[np.ndarray, "4 4"]:
        assert self.frame.T_world_camera is not None
        return self.frame.T_world_camera

    def points_world(self, erode: int = 1) -> Float[np.ndarray, "n 3"]:
        """Return the measured points of the mask in the world frame, without those near its border.

        Masks with fewer than 20 pixels inside the border are returned whole.
        """
        mask = self.mask & (self.frame.depth > 0)
        if self.ignore is not None:
            mask &= ~self.ignore
        inner = cv2.erode(mask.astype(np.uint8), np.ones((2 * erode + 1,) * 2, np.uint8))
        at = np.flatnonzero(inner if np.count_nonzero(inner) >= 20 else mask)  # ten times as fast as in 2D
        v, u = np.divmod(at, mask.shape[1])
        rays = pixel_rays(self.frame, u, v)
        return transform_points(
            self.T_world_camera, rays * self.frame.depth[v, u][:, None].astype(np.float64)
        )


def measured_points(observations: Sequence[ObjectObservation], erode: int = 1) -> Float[np.ndarray, "n 3"]:
    """Return the measured points of several observations in the world frame, in metres: ``points_world``."""
    return np.concatenate([np.zeros((0, 3)), *(seen.points_world(erode) for seen in observations)])


@dataclass(frozen=True)
class ObjectViews:
    """All observations of one object instance.

    Attributes:
        id: Instance id.
        category: Class of the object.
        score: Confidence of the class, in 0..1.
        observations: One observation per view.
        class_probabilities: (5,) probabilities of CATEGORIES and 'other'; empty if unknown.
        pose_probabilities: (10,) probabilities of POSED_CLASSES and 'other', for any resting pose; empty if
            unknown.
        axis_probabilities: (A,) of the direction of a lying axis as in ObjectDetection; empty if unknown.
        start: Estimate from fewer images, at which the fit of its class starts; None for a fit from nothing.
    """

    id: int
    category: Category
    score: float
    observations: tuple[ObjectObservation, ...]
    class_probabilities: Float[np.ndarray, "k"] = field(default_factory=lambda: np.zeros(0))
    pose_probabilities: Float[np.ndarray, "p"] = field(default_factory=lambda: np.zeros(0))
    axis_probabilities: Float[np.ndarray, "a"] = field(default_factory=lambda: np.zeros(0))
    start: ObjectEstimate | None = None

    @property
    def is_unclassified(self) -> bool:
        """Whether no class is preferred: the detector found the object, but gave it none."""
        return self.class_probabilities.size > 0 and float(np.ptp(self.class_probabilities)) == 0.0


@dataclass(frozen=True)
class PixelConfig:
    """Selection and weights of the pixels.

    Attributes:
        ring: Width of the background ring as a fraction of the object's larger side in the image.
        band: Half width of the ignored band along the mask's border, in pixels of the full image.
        background_weight: Weight of a background pixel relative to an object pixel.
        sparse_background: Whether background pixels are subsampled in a chessboard pattern with doubled
            weight where nothing is blurred (pyramid level 0).
    """

    ring: float = 0.2
    band: float = 2.0
    background_weight: float = 0.2
    sparse_background: bool = False


@dataclass(frozen=True)
class SamplingRange:
    """Depth range around an object that is sampled along the rays of every view.

    Attributes:
        centre: (3,) middle of the range in the world frame, in metres.
        reach: Half the range along the optical axis, in metres.
        samples: Number of render samples over the range.
    """

    centre: Float[np.ndarray, "3"]
    reach: float
    samples: int

    @staticmethod
    def around(centre: Float[np.ndarray, "3"], bounding_radius: float, step: float) -> SamplingRange:
        """Return the range for an object.

        Args:
            centre: (3,) middle of the object in the world frame, in metres.
            bounding_radius: Radius of a sphere around the centre that contains the object, in metres.
            step: Length of a render step, in metres.
        """
        reach = sampling_radius(bounding_radius)
        return SamplingRange(centre, reach, ray_samples(reach, step))


@dataclass(frozen=True)
class Crop:
    """Resolution of the crops around the masks.

    Attributes:
        size: Pixels along the longer side.
        level: Pyramid level: number of times the residuals are blurred and halved.
        reference: Crop size whose pixels have unit area, so that finer crops do not add information; None
            for ``size`` itself.
    """

    size: int
    level: int = 0
    reference: int | None = None


@dataclass(frozen=True)
class PixelSet:
    """Pixels of all views at one resolution.

    Attributes:
        rays: The n rendered pixels.
        Ts_world_camera: (v, 4, 4) camera poses.
        target: (n,) measured depth on the object, escape depth on the background, in metres.
        inside: (n,) whether the pixel shows the object.
        weight: (n,) area of the pixel, times ``background_weight`` on the background.
        operator: (m, n) pyramid matrix from pixels to residuals, or None at level 0.
    """

    rays: RayBundle
    Ts_world_camera: Float[np.ndarray, "v 4 4"]
    target: Float[np.ndarray, "n"]
    inside: Bool[np.ndarray, "n"]
    weight: Float[np.ndarray, "n"]
    operator: sparse.csr_matrix | None

    @cached_property
    def is_object(self) -> Bool[np.ndarray, "m"]:
        """Residuals with more than half of their weight on the object."""
        return self.inside if self.operator is None else self.operator @ self.inside.astype(np.float32) > 0.5


def pixel_rays(frame: RgbdFrame, u: np.ndarray, v: np.ndarray) -> Float[np.ndarray, "*n 3"]:
    """Return back-projected pixels in the camera frame, with z = 1."""
    camera = frame.intrinsics
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(np.shape(u))], axis=-1)


def gather_pixels(
    observations: Sequence[ObjectObservation],
    sampling: SamplingRange,
    crop: Crop,
    config: PixelConfig,
    threads: int = 1,
) -> PixelSet:
    """Sample the surroundings of every view's mask on a grid of at most ``crop.size`` squared pixels.

    Args:
        observations: Views of one object.
        sampling: Depth range of the rays.
        crop: Resolution.
        config: Selection and weights of the pixels.
        threads: Number of cores that render the pixels.
    """
    directions, view, target, inside, area, operators, depth_range = [], [], [], [], [], [], []
    sparse_background = config.sparse_background and not crop.level
    background_weight = config.background_weight * (2.0 if sparse_background else 1.0)
    for index, seen in enumerate(observations):
        z = float(transform_points(invert(seen.T_world_camera), sampling.centre[None])[0, 2])
        near, far = max(z - sampling.reach, 0.02), z + sampling.reach
        rays = RayBundle(np.empty((0, 3)), np.empty(0, np.int64), np.array([[near, far]]), sampling.samples)
        window = _Window.around(seen.mask, config.ring)
        u, v, is_object, is_background = _classify(seen, window, crop.size, config, (near, far))
        if sparse_background:
            is_background[::2, ::2] = is_background[1::2, 1::2] = False
        valid = is_object | is_background
        measured = np.where(is_object, seen.frame.depth[v, u], rays.escape_depth[0])
        directions.append(pixel_rays(seen.frame, u, v)[valid])
        view.append(np.full(int(valid.sum()), index))
        target.append(measured[valid])
        inside.append(is_object[valid])
        of_pixel = (window.pitch(crop.size) / window.pitch(crop.reference or crop.size)) ** 2
        area.append(np.full(int(valid.sum()), of_pixel))
        if crop.level:
            operators.append(pyramid_operator(valid, crop.level))
        depth_range.append((near, far))
    bundle = RayBundle(
        np.concatenate(directions).astype(np.float32),
        np.concatenate(view),
        np.array(depth_range),
        sampling.samples,
        threads,
    )
    on_object = np.concatenate(inside)
    return PixelSet(
        rays=bundle,
        Ts_world_camera=np.stack([seen.T_world_camera for seen in observations]),
        target=np.concatenate(target).astype(np.float32),
        inside=on_object,
        weight=(np.concatenate(area) * np.where(on_object, 1.0, background_weight)).astype(np.float32),
        operator=sparse.csr_matrix(sparse.block_diag(operators)) if crop.level else None,
    )


@dataclass(frozen=True)
class _Window:
    """Image window of a mask and the ring around it: rows and columns, both ends included, in pixels."""

    top: int
    bottom: int
    left: int
    right: int
    ring: int

    @staticmethod
    def around(mask: Bool[np.ndarray, "h w"], ring_share: float) -> _Window:
        (top, bottom), (left, right) = (np.flatnonzero(mask.any(axis=k))[[0, -1]].tolist() for k in (1, 0))
        ring = max(4, round(ring_share * (max(bottom - top, right - left) + 1)))
        height, width = mask.shape
        return _Window(
            max(top - ring, 0), min(bottom + ring, height - 1), max(left - ring, 0),
            min(right + ring, width - 1), ring,
        )  # fmt: skip

    def pitch(self, crop: int) -> float:
        """Return the spacing of a crop's pixels in pixels of the image, at least one."""
        return max(1.0, (max(self.bottom - self.top, self.right - self.left) + 1) / crop)


def _classify(
    seen: ObjectObservation,
    window: _Window,
    crop: int,
    config: PixelConfig,
    depth_range: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the crop's pixel coordinates u, v, and which of them show the object or the background."""
    near, far = depth_range
    top, bottom, left, right = window.top, window.bottom, window.left, window.right
    pitch = window.pitch(crop)
    v = np.unique(np.round(np.arange(top, bottom + 0.5, pitch)).astype(int).clip(top, bottom))
    u = np.unique(np.round(np.arange(left, right + 0.5, pitch)).astype(int).clip(left, right))
    u, v = np.meshgrid(u, v)

    mask = np.ascontiguousarray(seen.mask[top : bottom + 1, left : right + 1]).astype(np.uint8)
    inwards = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    outwards = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 3)
    inwards, outwards = inwards[v - top, u - left], outwards[v - top, u - left]
    depth = seen.frame.depth[v, u]
    usable = depth > 0
    if seen.ignore is not None:
        usable &= ~seen.ignore[v, u]
    is_object = usable & (inwards > config.band) & (depth > near) & (depth < far)
    is_background = usable & (outwards > config.band) & (outwards <= window.ring)
    return u, v, is_object, is_background
