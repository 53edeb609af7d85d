"""Evidence of a fit: how well a fitted shape explains what the cameras measure, as a few numbers.

The shape is rendered into every view once more and compared with the measured depth, pixel by pixel:

- inside the mask, the shape is in front of, at, or behind the measured surface, or does not cover the pixel;
- outside the mask, it is violated where the camera sees a surface clearly behind it (free space).

The noise of depth sensors grows with the distance; differences count in units of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
from jaxtyping import Bool, Float

from perception.detection.geometry import touches_border
from perception.geometry import invert, transform_points
from perception.inference.observation import (
    ObjectObservation,
    pixel_rays,
    ray_samples,
    sampling_radius,
)
from perception.rendering.pose import ObjectPose, canonical_from_camera
from perception.rendering.renderer import RayBundle, ShapeGrid, render
from perception.types import GRID_RESOLUTION, ObjectEstimate, SupportPlane

_CROP = 56  # pixels along the longer side of a view's window
_BAND = 2.0  # [px] half width of the mask's border, which is not used
_LARGE = 0.03  # [m] largest residual of the blockwise means
_BLOCK = 5  # side of the blocks whose mean residual shows systematic misfit, in pixels of the crop
_NOTHING = 10.0  # residual without any pixel to compare, in standard deviations
_MIN_BLOCK = 12  # smallest number of residuals in a block


def noise_sigma(depth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the standard deviation of a depth measurement of a typical sensor, in metres."""
    return 0.0015 + 0.002 * depth**2


def tolerance(depth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the depth difference from which two surfaces are clearly apart, in metres."""
    return 0.008 + 3.0 * noise_sigma(depth)


@dataclass(frozen=True)
class Evidence:
    """Evidence of one fit over all its views. Shares are in 0..1.

    Attributes:
        explained: Share of the mask's measured pixels at which shape and measurement agree.
        uncovered: Share of the mask's measured pixels that the shape does not cover.
        in_front: Share of the mask's measured pixels whose surface is clearly in front of the shape.
        behind: Share of the mask's measured pixels whose surface is clearly behind the shape.
        free_space: Share of the shape's visible pixels outside the mask that are measured clearly behind it.
        residual: Median depth residual in the mask, in standard deviations of a typical sensor.
        systematic: Root mean square of blockwise mean residuals, in the same unit: noise averages out, a
            different shape does not.
        missing: Share of the mask without measured depth.
        base: Height of the lowest measured points above the plane, in object heights; negative below it.
        truncated: Share of the views whose mask touches the image border.
        pixels: Number of measured pixels in the mask of the largest view.
        code: Norm of the shape code in standard deviations of the prior, divided by 4.
        section: Log ratio of the scales along x and y, absolute.
        aspect: Log ratio of the scale along z and the mean of x and y.
        height: Height of the shape, in metres.
        radius: Half the extent of the shape along the object's y, in metres.
        neck, box: Measures of the cross-sections, see ``section_shapes``.
        converged: 1 if the fit converged to a plausible object, else 0.
    """

    explained: float
    uncovered: float
    in_front: float
    behind: float
    free_space: float
    residual: float
    systematic: float
    missing: float
    base: float
    truncated: float
    pixels: float
    code: float
    section: float
    aspect: float
    height: float
    radius: float
    neck: float
    box: float
    converged: float

    def as_dict(self) -> dict[str, float]:
        """Return the numbers by name."""
        return {field.name: float(getattr(self, field.name)) for field in fields(self)}


def measure_evidence(
    estimate: ObjectEstimate,
    grid: Float[np.ndarray, "r r r"],
    observations: Sequence[ObjectObservation],
    plane: SupportPlane,
    step: float,
) -> Evidence:
    """Render a fitted shape into its views and compare it with the measured depth.

    Args:
        estimate: Result of the fit.
        grid: Occupancies of its code.
        observations: Views of the object, at least one.
        plane: Support plane.
        step: Length of a render step, in voxels.
    """
    pose = ObjectPose.of(estimate.T_world_object, estimate.scale)
    views = [_Window.around(seen, estimate) for seen in observations]
    counts = np.zeros(7)
    residuals, blocks, base = [], [], []
    for view, (depth, hit) in zip(views, _render(grid, pose, views, step)):
        counts += _counts(view, depth, hit)
        gap = np.where(view.inside & (hit > 0.5), depth - view.measured, np.nan) / noise_sigma(view.measured)
        residuals.append(np.abs(gap[np.isfinite(gap)]))
        blocks.append(_block_means(np.where(np.abs(depth - view.measured) < _LARGE, gap, np.nan)))
        base.append(_base(view, plane))
    inside, agree, uncovered, in_front, behind, testable, violated = counts.tolist()
    all_residuals, all_blocks = np.concatenate(residuals), np.concatenate(blocks)
    scale = np.log(estimate.scale)
    masked = sum(int(seen.mask.sum()) for seen in observations)
    measured = [int((seen.mask & (seen.frame.depth > 0)).sum()) for seen in observations]
    neck, box = section_shapes(estimate)
    return Evidence(
        explained=agree / max(inside, 1),
        uncovered=uncovered / max(inside, 1),
        in_front=in_front / max(inside, 1),
        behind=behind / max(inside, 1),
        free_space=violated / max(testable, 1),
        residual=float(np.median(all_residuals)) if len(all_residuals) else _NOTHING,
        systematic=float(np.sqrt(np.mean(all_blocks**2))) if len(all_blocks) else _NOTHING,
        missing=1 - sum(measured) / masked,
        base=min(base) / max(estimate.height, 0.01),
        truncated=float(np.mean([touches_border(seen.mask) for seen in observations])),
        pixels=float(max(measured)),
        code=float(np.linalg.norm(estimate.code)) / 4,
        section=float(abs(scale[0] - scale[1])),
        aspect=float(scale[2] - scale[:2].mean()),
        height=estimate.height,
        radius=estimate.radius,
        neck=neck,
        box=box,
        converged=float(estimate.status == "converged"),
    )


def section_shapes(estimate: ObjectEstimate) -> tuple[float, float]:
    """Return two measures of the cross-sections of a mesh.

    Returns:
        neck: Area near the top relative to the largest of all sections; a bottle's is small.
        box: Area of the middle section relative to its bounding rectangle: pi/4 for an ellipse, 1 for a box.
    """
    vertices = estimate.mesh.vertices
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    level = (vertices[:, 2] - low) / max(high - low, 1e-6)
    slabs = [_hull(vertices[(level >= a) & (level < a + 0.12), :2]) for a in np.arange(0.04, 0.9, 0.12)]
    areas = [0.0 if hull is None else float(cv2.contourArea(hull)) for hull in slabs]
    middle = slabs[len(slabs) // 2]
    if middle is None or max(areas) <= 0:
        return 0.0, 0.0
    (_, (width, depth), _) = cv2.minAreaRect(middle)
    return areas[-1] / max(areas), float(cv2.contourArea(middle)) / max(width * depth, 1e-9)


def _hull(points: Float[np.ndarray, "n 2"]) -> np.ndarray | None:
    """Return the convex hull of points, in millimetres; None for fewer than three."""
    return cv2.convexHull((1000 * points).astype(np.float32)) if len(points) >= 3 else None


@dataclass(frozen=True)
class _Window:
    """Crop of a view around its mask and the projected shape.

    Attributes:
        seen: The view.
        u, v: (h, w) pixels of the crop in the image.
        rays: (h, w, 3) their rays, z = 1.
        measured: (h, w) measured depth, 0 where missing.
        inside: (h, w) measured pixels well inside the mask.
        outside: (h, w) measured pixels well outside the mask that are not to be ignored.
    """

    seen: ObjectObservation
    u: np.ndarray
    v: np.ndarray
    rays: Float[np.ndarray, "h w 3"]
    measured: Float[np.ndarray, "h w"]
    inside: Bool[np.ndarray, "h w"]
    outside: Bool[np.ndarray, "h w"]

    @staticmethod
    def around(seen: ObjectObservation, estimate: ObjectEstimate) -> _Window:
        height, width = seen.mask.shape
        low, high = estimate.mesh.vertices.min(axis=0), estimate.mesh.vertices.max(axis=0)
        corners = np.array([np.where(corner, high, low) for corner in np.ndindex(2, 2, 2)])
        points = transform_points(invert(seen.T_world_camera) @ estimate.T_world_object, corners)
        points = points[points[:, 2] > 0.05]
        camera = seen.frame.intrinsics
        x, y, w, h = cv2.boundingRect(seen.mask.view(np.uint8))
        columns, rows = [x, x + w - 1], [y, y + h - 1]
        if len(points):
            columns += list(camera.fx * points[:, 0] / points[:, 2] + camera.cx)
            rows += list(camera.fy * points[:, 1] / points[:, 2] + camera.cy)
        left, right = (int(np.clip(f(columns), 0, width - 1)) for f in (min, max))
        top, bottom = (int(np.clip(f(rows), 0, height - 1)) for f in (min, max))
        pitch = max(1.0, max(right - left, bottom - top) / _CROP)
        u, v = np.meshgrid(
            np.arange(left, right + 0.5, pitch).astype(int), np.arange(top, bottom + 0.5, pitch).astype(int)
        )
        mask = np.ascontiguousarray(seen.mask[top : bottom + 1, left : right + 1]).astype(np.uint8)
        inwards = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, 3)[1:-1, 1:-1][v - top, u - left]
        outwards = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 3)[v - top, u - left]
        measured = seen.frame.depth[v, u]
        usable = measured > 0
        if seen.ignore is not None:
            usable &= ~seen.ignore[v, u]
        return _Window(
            seen,
            u,
            v,
            pixel_rays(seen.frame, u, v),
            measured,
            usable & (inwards > _BAND),
            usable & (outwards > _BAND),
        )


def _render(
    grid: Float[np.ndarray, "r r r"], pose: ObjectPose, views: Sequence[_Window], step: float
) -> list[tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]]:
    """Return the rendered depth, in metres, and the probability of a hit of every pixel of every view."""
    reach = sampling_radius(float(np.linalg.norm(pose.scale)))
    voxel = 2 * float(pose.scale.mean()) / GRID_RESOLUTION
    centre = pose.translation[None]
    z = [float(transform_points(invert(view.seen.T_world_camera), centre)[0, 2]) for view in views]
    rays = RayBundle(
        np.concatenate([view.rays.reshape(-1, 3) for view in views]).astype(np.float32),
        np.repeat(np.arange(len(views)), [view.u.size for view in views]),
        np.array([(max(d - reach, 0.02), max(d + reach, 0.04)) for d in z]),
        ray_samples(reach, step * voxel),
    )
    A = canonical_from_camera(pose, np.stack([view.seen.T_world_camera for view in views]))
    image = render(ShapeGrid.upload(grid, skip_occupancy=5e-3), rays, A, gradients=False)
    return [
        (image.depth[rows].reshape(view.u.shape), image.mask[rows].reshape(view.u.shape))
        for view, rows in zip(views, rays.view_slices)
    ]


def _counts(
    view: _Window, depth: Float[np.ndarray, "h w"], hit: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "7"]:
    """Return the numbers of pixels: inside, agreeing, uncovered, in front, behind; testable, violated.

    The rendered depth of a pixel that the shape covers in part is a mixture with the background: only pixels
    that it covers almost surely are compared.
    """
    measured, apart = view.measured, tolerance(view.measured)
    covered, missed = hit > 0.8, hit < 0.2
    ahead, beyond = measured < depth - apart, measured > depth + apart
    inside = view.inside & (covered | missed)
    testable = covered & (view.inside | view.outside) & ~ahead
    return np.array([
        inside.sum(),
        (inside & covered & ~ahead & ~beyond).sum(),
        (inside & missed).sum(),
        (inside & covered & ahead).sum(),
        (inside & covered & beyond).sum(),
        testable.sum(),
        (testable & view.outside & beyond).sum(),
    ], dtype=np.float64)  # fmt: skip


def _block_means(residual: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "k"]:
    """Return the mean residual of overlapping blocks with enough residuals; NaN pixels do not count."""
    known = np.isfinite(residual)
    window = (_BLOCK, _BLOCK)
    total = cv2.boxFilter(np.where(known, residual, 0.0), -1, window, normalize=False)
    count = cv2.boxFilter(known.astype(np.float64), -1, window, normalize=False)
    enough = known & (count >= _MIN_BLOCK)
    return total[enough] / count[enough]


def _base(view: _Window, plane: SupportPlane) -> float:
    """Return the height of the lowest measured points of the mask above the plane, in metres."""
    points = view.rays[view.inside] * view.measured[view.inside][:, None]
    if len(points) < 10:
        return 0.0
    return float(np.quantile(plane.height_above(transform_points(view.seen.T_world_camera, points)), 0.03))
