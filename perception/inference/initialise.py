"""Initial pose: centre, size and upright orientation from the masked clouds and the support plane.

Across the line of sight the cloud of a view has the extent of the object; along it only the near side is
visible, so the centre lies one radius behind it. Least squares combines the views.
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
from perception.inference.yaw_prior import yaw_modes
from perception.rendering.pose import ObjectPose
from perception.types import Category, SupportPlane

LONGEST_SIDE = 1.8  # longest side of an object in the canonical cube of side 2

MIN_HEIGHT = 0.003  # [m] points lower than this belong to the plane
MIN_POINTS = 30
_STEEP = np.deg2rad(68.0)  # elevation of the camera above which near and far side are visible
BLIND_YAWS = 6  # hypotheses for a mug without a yaw distribution


@dataclass(frozen=True)
class CloudMeasures:
    """Measures of the masked clouds of all views.

    Attributes:
        centre: Centre of the object in the coordinates of the plane, in metres.
        radius: Half the width across the line of sight, median of the views, in metres.
        height: Height above the plane, median of the views, in metres.
        outline: All points of the object projected onto the plane, in metres.
    """

    centre: Float[np.ndarray, "2"]
    radius: float
    height: float
    outline: Float[np.ndarray, "n 2"]

    @property
    def bounding_radius(self) -> float:
        """Radius of a sphere about the object's centre that contains it with a margin of 25 %, in metres."""
        return 1.25 * float(np.hypot(self.radius, self.height / 2))


def initial_poses(
    observations: Sequence[ObjectObservation], category: Category, plane: SupportPlane
) -> tuple[list[ObjectPose], CloudMeasures]:
    """Return upright initial poses, the most probable yaw first, and the measures they come from.

    The bounding boxes of the shape prior's grids are centred, their longest side is ``LONGEST_SIDE``: height
    and width of the cloud give centre and scale.

    Raises:
        InvalidInputError: No view has enough points above the plane.
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
    """Return as rows two directions in the plane, the first near world x, and the normal."""
    return upright_rotation(plane.normal, 0.0).T


def measure_clouds(
    observations: Sequence[ObjectObservation], plane: SupportPlane, basis: Float[np.ndarray, "3 3"]
) -> CloudMeasures:
    """Return the measures of the clouds; ``basis`` as from ``plane_basis``.

    Raises:
        InvalidInputError: No view has enough points above the plane.
    """
    rows, values, weights, radii, heights, outline = [], [], [], [], [], []
    for seen in observations:
        points = seen.points_world()
        height = plane.height_above(points)
        above = height > MIN_HEIGHT
        if above.sum() < MIN_POINTS:
            continue
        flat = points[above] @ basis[:2].T
        outline.append(flat)
        heights.append(np.quantile(height[above], 0.998))
        ahead, steep = line_of_sight(seen, flat, plane, basis)
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
            f"no view has {MIN_POINTS} measured points {MIN_HEIGHT * 1000:.0f} mm above the support plane "
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


def line_of_sight(
    seen: ObjectObservation,
    flat: Float[np.ndarray, "n 2"],
    plane: SupportPlane,
    basis: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "2"], bool]:
    """Return the direction in the plane from the camera to points in it, and whether the view is steep.

    In steep views, in which both near and far side are visible, any direction will do.
    """
    camera = seen.T_world_camera[:3, 3]
    towards = flat.mean(axis=0) - basis[:2] @ camera
    elevation = np.arctan2(plane.height_above(camera[None])[0], np.linalg.norm(towards))
    if elevation > _STEEP:
        return np.array([1.0, 0.0]), True
    return towards / np.linalg.norm(towards), False


def yaw_hypotheses(
    observations: Sequence[ObjectObservation], category: Category, measures: CloudMeasures
) -> list[float]:
    """Return yaw hypotheses about the plane's normal, in radians, the most probable first."""
    if category == "mug":
        yaws = yaw_modes(observations)
        return yaws or [2 * np.pi * k / BLIND_YAWS for k in range(BLIND_YAWS)]
    if category == "bottle":  # sections may be rectangular, with the long or the short side along x
        (_, (along, across), degrees) = cv2.minAreaRect(measures.outline.astype(np.float32))
        yaw = np.deg2rad(degrees) + (0.0 if along >= across else np.pi / 2)
        return [yaw, yaw + np.pi / 2]
    return [0.0]
