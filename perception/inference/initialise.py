"""Initial pose: centre, size and upright orientation from the masked clouds and the support plane.

Across the line of sight the cloud of a view has the extent of the object; along it only the near side is
seen, so the centre is pushed behind it by the radius. Least squares combines the views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from perception.errors import InvalidInputError
from perception.geometry import upright_rotation
from perception.inference.observation import ObjectObservation
from perception.rendering.pose import ObjectPose
from perception.types import Category, SupportPlane

LONGEST_SIDE = 1.8  # of the canonical cube's 2

_MIN_HEIGHT = 0.003  # [m] points lower than this belong to the plane
_MIN_POINTS = 30
_STEEP = np.deg2rad(68.0)  # views from above this elevation see near and far side
_MAX_YAWS = 5
_LEAST_LIKELY = 0.3  # of the likeliest yaw's probability: less likely ones are not tried
_YAW_REACH = np.deg2rad(25.0)  # from so far a fit finds the handle by itself
_BLIND_YAWS = 6  # hypotheses for a mug without a yaw distribution


@dataclass(frozen=True)
class CloudMeasures:
    """Clouds, in metres: ``centre`` and ``outline`` (all points) in the plane, radius, height."""

    centre: Float[np.ndarray, "2"]
    radius: float
    height: float
    outline: Float[np.ndarray, "n 2"]

    @property
    def bounding_radius(self) -> float:
        """Radius of a sphere about the object's middle that holds it, with a quarter of slack [m]."""
        return 1.25 * float(np.hypot(self.radius, self.height / 2))


def initial_poses(
    observations: Sequence[ObjectObservation], category: Category, plane: SupportPlane
) -> tuple[list[ObjectPose], CloudMeasures]:
    """Return upright initial poses, the most probable yaw first, and the measures they come from.

    The shape prior's grids hold bounding boxes that are centred and ``LONGEST_SIDE`` long, so the cloud's
    height and width give centre and scale.
    """
    basis = plane_basis(plane)
    measures = measure_clouds(observations, plane, basis)
    foot = basis[:2].T @ measures.centre + plane.normal * plane.offset
    centre = foot + plane.normal * (measures.height / 2)
    scale = max(measures.height, 2 * measures.radius) / LONGEST_SIDE
    poses = [
        ObjectPose(upright_rotation(plane.normal, yaw), centre, np.full(3, scale))
        for yaw in yaw_hypotheses(observations, category, measures)
    ]
    return poses, measures


def plane_basis(plane: SupportPlane) -> Float[np.ndarray, "3 3"]:
    """Rows: two directions in the plane, the first near world x, and the normal."""
    return upright_rotation(plane.normal, 0.0).T


def measure_clouds(
    observations: Sequence[ObjectObservation], plane: SupportPlane, basis: Float[np.ndarray, "3 3"]
) -> CloudMeasures:
    """Return centre, radius and height; raises InvalidInputError if nothing is above the plane."""
    rows, values, weights, radii, heights, outline = [], [], [], [], [], []
    for seen in observations:
        points = seen.points_world()
        height = plane.height_above(points)
        above = height > _MIN_HEIGHT
        if above.sum() < _MIN_POINTS:
            continue
        flat = points[above] @ basis[:2].T
        outline.append(flat)
        heights.append(np.quantile(height[above], 0.998))
        camera = seen.T_world_camera[:3, 3]
        towards = flat.mean(axis=0) - basis[:2] @ camera
        elevation = np.arctan2(plane.height_above(camera[None])[0], np.linalg.norm(towards))
        steep = elevation > _STEEP
        ahead = towards / np.linalg.norm(towards) if not steep else np.array([1.0, 0.0])
        across = np.array([-ahead[1], ahead[0]])
        low, high = np.quantile(flat @ across, (0.003, 0.997))
        near, far = np.quantile(flat @ ahead, (0.003, 0.997))
        radius = (high - low) / 2
        behind = (near + far) / 2 if steep else max(near + radius, (near + far) / 2)
        rows += [across, ahead]
        values += [(low + high) / 2, behind]
        weights += [1.0, 1.0 if steep else 0.3]
        radii.append(radius)
    if not rows:
        raise InvalidInputError(
            f"no view has {_MIN_POINTS} measured points {_MIN_HEIGHT * 1000:.0f} mm above the support plane "
            "inside the object's mask; check the mask, the depth and the plane"
        )
    w = np.array(weights)
    centre = np.linalg.lstsq(np.array(rows) * w[:, None], np.array(values) * w, rcond=None)[0]
    return CloudMeasures(
        centre,
        max(float(np.median(radii)), 0.005),
        max(float(np.median(heights)), 0.01),
        np.concatenate(outline),
    )


def yaw_hypotheses(
    observations: Sequence[ObjectObservation], category: Category, measures: CloudMeasures
) -> list[float]:
    """Return yaw hypotheses about the plane's normal, in radians, the most probable first."""
    if category == "mug":
        return _modes([o.yaw_probabilities for o in observations if o.yaw_probabilities.size])
    if category == "bottle":  # may have a rectangular section, long or short side along x
        (_, (along, across), degrees) = cv2.minAreaRect(measures.outline.astype(np.float32))
        yaw = np.deg2rad(degrees) + (0.0 if along >= across else np.pi / 2)
        return [yaw, yaw + np.pi / 2]
    return [0.0]


def _modes(distributions: list[np.ndarray]) -> list[float]:
    """Yaws that cover the fused distribution, or evenly spread ones where there is none.

    A sharp distribution has one; a flat one, of a handle hardly seen, has several a fit's reach apart.
    """
    if not distributions:
        return [2 * np.pi * k / _BLIND_YAWS for k in range(_BLIND_YAWS)]
    bins = len(distributions[0])
    log_p = np.mean([np.log(np.maximum(p, 1e-4)) for p in distributions], axis=0)
    p = np.exp(log_p - log_p.max())
    left, reach, yaws = p.copy(), int(_YAW_REACH / (2 * np.pi) * bins), []
    while len(yaws) < _MAX_YAWS and left.max() > _LEAST_LIKELY:
        k = int(left.argmax())
        yaws.append(2 * np.pi * (k + _vertex(p[k - 1], p[k], p[(k + 1) % bins])) / bins)
        left[np.arange(k - reach, k + reach + 1) % bins] = 0.0
    return yaws


def _vertex(left: float, middle: float, right: float) -> float:
    """Offset of a parabola's top through three neighbours, in bins."""
    curvature = left - 2 * middle + right
    return 0.0 if curvature >= 0 else float(np.clip(0.5 * (left - right) / curvature, -0.5, 0.5))
