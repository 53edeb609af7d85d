"""Resting poses: initial poses of upright, upside-down and lying objects, and whether a pose is at rest.

The upper part of a lying cylinder seen from above is a strip along its axis, visible to both sides of it: the
principal axis of these points in the plane is the axis of the object. Their highest point gives the diameter,
the extent of all points along the axis the length.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Float

from perception.errors import InvalidInputError
from perception.geometry import upright_rotation
from perception.inference.initialise import (
    BLIND_YAWS,
    LONGEST_SIDE,
    MIN_HEIGHT,
    MIN_POINTS,
    CloudMeasures,
    initial_poses,
    line_of_sight,
    measure_clouds,
    plane_basis,
)
from perception.inference.observation import ObjectObservation
from perception.rendering.pose import ObjectPose
from perception.surface_geometry import centre_of_mass
from perception.types import POSES_OF, Category, RestingPose, SupportPlane, TriangleMesh

ALTERNATIVES: Mapping[Category, tuple[RestingPose, ...]] = {
    category: tuple(pose for pose in poses if pose != "upright") for category, poses in POSES_OF.items()
}

_STRIP = 0.85  # height from which on points belong to the strip along the axis, in heights of the object
_ROUND = 1.5  # ratio of the strip's standard deviations below which its axis is uncertain
# Angles from the upward direction to the object's x axis about its z axis. Handles of mugs touch the plane on
# one side, or are in the air; sections of bottles may be rectangular.
_ROLLS: Mapping[Category, tuple[float, ...]] = {
    "mug": tuple(np.deg2rad([60.0, 110.0, -60.0, -110.0, 0.0]).tolist()),
    "bowl": (0.0,),
    "bottle": (0.0, np.pi / 2),
    "can": (0.0,),
}
_CONTACT = 0.08  # height of a contact over the lowest point, in extents: the error of a fitted tilt
_SLACK = 0.01  # [m] by which the hull of the contacts is widened: handles are fitted less exactly than bodies


def initial_resting_poses(
    observations: Sequence[ObjectObservation],
    category: Category,
    plane: SupportPlane,
    resting: RestingPose = "upright",
    toward: Float[np.ndarray, "3"] | None = None,
) -> tuple[list[ObjectPose], CloudMeasures]:
    """Return initial poses in one resting pose, the most probable first, and the measures they come from.

    Args:
        observations: Views of the object.
        category: Class of the object.
        plane: What the object rests on.
        resting: Resting pose.
        toward: Direction of the axis in world coordinates, to which that of a lying object is levelled; None
            for any.

    Raises:
        InvalidInputError: No view has enough points above the plane.
    """
    if resting == "lying":
        return _lying_poses(observations, category, plane, toward)
    poses, measures = initial_poses(observations, category, plane)
    if resting == "upside-down":
        poses = [_turned_over(poses[0], plane, yaw) for yaw in _yaws(category)]
    return poses, measures


def tilt_error(rotation: Float[np.ndarray, "3 3"], plane: SupportPlane, resting: RestingPose) -> float:
    """Return the angle between an object's axis and its direction in a resting pose, in radians."""
    cosine = float(np.clip(rotation[:, 2] @ plane.normal, -1, 1))
    return {
        "upright": float(np.arccos(cosine)),
        "lying": float(abs(np.arcsin(cosine))),
        "upside-down": float(np.arccos(-cosine)),
    }[resting]


def resting_pose(rotation: Float[np.ndarray, "3 3"], plane: SupportPlane) -> RestingPose:
    """Return the resting pose nearest to a rotation: the axis within 45 degrees of up, level, or down."""
    cosine = float(rotation[:, 2] @ plane.normal)
    if abs(cosine) < np.sqrt(0.5):
        return "lying"
    return "upright" if cosine > 0 else "upside-down"


def rests_stably(mesh_world: TriangleMesh, plane: SupportPlane) -> bool:
    """Return whether a solid in a given pose rests on a plane without toppling.

    The vertical through its centre of mass passes through the convex hull of its contacts, the vertices near
    the height of the lowest one, with some slack.
    """
    height = plane.height_above(mesh_world.vertices)
    across = plane_basis(plane)[:2]
    reach = _CONTACT * float(np.ptp(mesh_world.vertices, axis=0).max())
    contacts = mesh_world.vertices[height <= height.min() + reach] @ across.T
    hull = cv2.convexHull((1000 * contacts).astype(np.float32))
    mass = 1000 * across @ centre_of_mass(mesh_world)
    return cv2.pointPolygonTest(hull, mass.tolist(), True) > -1000 * _SLACK


def principal_axis(points: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Return the direction of largest variance, and the ratio of the deviations along and across it."""
    values, vectors = np.linalg.eigh(np.cov(points.T))
    return vectors[:, 1], float(np.sqrt(values[1] / max(values[0], 1e-12)))


def _turned_over(upright: ObjectPose, plane: SupportPlane, yaw: float) -> ObjectPose:
    rotation = upright_rotation(plane.normal, yaw) @ np.diag([1.0, -1.0, -1.0])
    return ObjectPose(rotation, upright.translation, upright.scale)


def _yaws(category: Category) -> list[float]:
    """Return yaw hypotheses: those of the networks hold for upright mugs alone."""
    return [2 * np.pi * k / BLIND_YAWS for k in range(BLIND_YAWS)] if category == "mug" else [0.0]


def _lying_poses(
    observations: Sequence[ObjectObservation],
    category: Category,
    plane: SupportPlane,
    toward: Float[np.ndarray, "3"] | None,
) -> tuple[list[ObjectPose], CloudMeasures]:
    basis = plane_basis(plane)
    height = measure_clouds(observations, plane, basis).height
    clouds = [seen.points_world() for seen in observations]
    raised = [cloud[plane.height_above(cloud) > MIN_HEIGHT] for cloud in clouds]
    views = [(seen, cloud) for seen, cloud in zip(observations, raised) if len(cloud) >= MIN_POINTS]
    points = np.concatenate([cloud for _, cloud in views])
    plan = points @ basis[:2].T
    strip = plan[plane.height_above(points) > _STRIP * height]
    if len(strip) < 3:
        raise InvalidInputError(f"no view shows the upper side of the lying {category}")
    if toward is not None:  # a strip that is wide at one end hardly shows the axis
        level = basis[:2] @ toward
        axes, signs = [level / np.linalg.norm(level)], (1.0,)
    else:
        axis, elongation = principal_axis(strip)
        axes = [axis] if elongation > _ROUND else [axis, np.array([-axis[1], axis[0]])]
        signs = (1.0, -1.0)  # some cans, too, are narrower above
    poses, reach = [], 0.0
    for along in axes:
        across = np.array([-along[1], along[0]])
        length, width = (float(np.ptp(np.quantile(plan @ d, (0.003, 0.997)))) for d in (along, across))
        centre = _lying_centre(views, plane, basis, along, (length / 2, height / 2))
        middle = basis[:2].T @ centre + plane.normal * (plane.offset + height / 2)
        scale = np.full(3, max(length, width, height) / LONGEST_SIDE)
        reach = max(reach, float(np.hypot(length, width) / 2))
        poses += [ObjectPose(R, middle, scale) for R in _lying_rotations(category, basis, along, signs)]
    return poses, CloudMeasures(poses[0].translation @ basis[:2].T, reach, height, plan)


def _lying_rotations(
    category: Category,
    basis: Float[np.ndarray, "3 3"],
    along: Float[np.ndarray, "2"],
    signs: Sequence[float],
) -> list[Float[np.ndarray, "3 3"]]:
    """Return rotations with the object's z along a direction in the plane, times each sign, for all rolls."""
    rotations = []
    for sign in signs:
        z = sign * (basis[:2].T @ along)
        side = np.cross(z, basis[2])
        for roll in _ROLLS[category]:
            x = np.cos(roll) * basis[2] + np.sin(roll) * side
            rotations.append(np.stack([x, np.cross(z, x), z], axis=1))
    return rotations


def _lying_centre(
    views: Sequence[tuple[ObjectObservation, Float[np.ndarray, "_n 3"]]],
    plane: SupportPlane,
    basis: Float[np.ndarray, "3 3"],
    along: Float[np.ndarray, "2"],
    half: tuple[float, float],
) -> Float[np.ndarray, "2"]:
    """Return the centre in the plane of a box about an axis, from its visible side in every view.

    ``half`` are half its length and half its width, in metres.
    """
    across = np.array([-along[1], along[0]])
    rows, values, weights = [], [], []
    for seen, cloud in views:
        flat = cloud @ basis[:2].T
        ahead, steep = line_of_sight(seen, flat, plane, basis)
        aside = np.array([-ahead[1], ahead[0]])
        low, high = np.quantile(flat @ aside, (0.003, 0.997))
        near, far = np.quantile(flat @ ahead, (0.003, 0.997))
        depth = abs(ahead @ along) * half[0] + abs(ahead @ across) * half[1]
        rows += [aside, ahead]
        values += [(low + high) / 2, (near + far) / 2 if steep else max(near + depth, (near + far) / 2)]
        weights += [1.0, 1.0 if steep else 0.3]
    w = np.array(weights)
    return np.linalg.lstsq(np.array(rows) * w[:, None], np.array(values) * w, rcond=None)[0]
