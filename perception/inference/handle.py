"""Direction of the handle of an upright mug of known body, in new images of it.

What was below or behind other things when the mug was reconstructed, or was turned since, has its handle in
view later. The mask comes from the depth around the body, the direction from the yaw network.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from perception.detection.completion import Completer
from perception.detection.yaw import fuse_yaws
from perception.geometry import invert, nearest_yaw, pose_from_yaw, transform_points, wrapped_angle
from perception.inference.observation import pixel_rays
from perception.metrics import SurfaceSamples
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

SURE = 0.8  # least probability of the directions within ``NEAR`` of the most probable one
NEAR = np.deg2rad(20.0)
LEAST_TURN = np.deg2rad(8.0)  # between estimate and images, from which on these are right
HANDLE = 0.055  # [m] by which handles reach beyond the body, at most
BESIDE = 0.2  # [m] between the axes of a mug and of what may touch it
_ABOVE = 0.012  # [m] above the rim
_FLOOR = 0.006  # [m] above the base, from which on points are not of what it stands on
_EXPLAINED = 0.008  # [m] from another object's surface
_SAMPLES = 3000  # on the surface of another object
_LEAST = 800  # pixels of a mask


def handle_yaw(
    estimate: ObjectEstimate,
    frames: Sequence[RgbdFrame],
    others: Sequence[ObjectEstimate],
    plane: SupportPlane,
    network: Completer,
) -> float | None:
    """Return the direction of a mug's handle about z, in radians; None where the images leave it open.

    Args:
        estimate: Upright mug at its pose; its handle is not used.
        frames: Images of it, with camera poses.
        others: Objects beside it at their poses.
        plane: Support plane.
        network: Provides yaw distributions.
    """
    surfaces = [SurfaceSamples.of(o.mesh_world, np.random.default_rng(0), _SAMPLES) for o in others]
    found: list[Float[np.ndarray, "b"]] = []
    for frame in frames:
        mask = mask_around(estimate, frame, surfaces)
        if mask.sum() < _LEAST:
            continue
        (detection,) = network.complete(frame, plane, [ObjectDetection("mug", 1.0, mask)])
        if detection.yaw_probabilities.size:
            found.append(detection.yaw_probabilities)
    return sure_direction(fuse_yaws(found)) if found else None


def turned_to_handle(
    estimate: ObjectEstimate,
    frames: Sequence[RgbdFrame],
    others: Sequence[ObjectEstimate],
    plane: SupportPlane,
    network: Completer,
) -> ObjectEstimate | None:
    """Return an upright mug turned about the axis of its body to where images show its handle.

    None if they leave that open, or it points there already.

    Args:
        estimate, frames, others, plane, network: As those of ``handle_yaw``.
    """
    yaw = handle_yaw(estimate, frames, others, plane, network)
    if yaw is None:
        return None
    turn = wrapped_angle(yaw - nearest_yaw(estimate.T_world_object))
    if abs(turn) < LEAST_TURN:
        return None
    about = np.eye(4)
    about[:3, 3] = body_axis(estimate)
    T = estimate.T_world_object @ about @ pose_from_yaw(turn, np.zeros(3)) @ invert(about)
    return replace(estimate, T_world_object=T)


def with_seen_handles(
    estimates: Sequence[ObjectEstimate],
    frames: Sequence[RgbdFrame],
    plane: SupportPlane,
    network: Completer,
) -> list[ObjectEstimate]:
    """Return estimates with the upright mugs among them turned to where the images show their handles.

    Args:
        estimates: All objects.
        frames: Images of them, with camera poses.
        plane: Support plane.
        network: Provides yaw distributions.
    """
    result = []
    for estimate in estimates:
        turned = None
        if estimate.category == "mug" and estimate.resting == "upright":
            place = estimate.T_world_object[:2, 3]
            others = [
                other
                for other in estimates
                if other is not estimate and np.linalg.norm(other.T_world_object[:2, 3] - place) < BESIDE
            ]
            turned = turned_to_handle(estimate, frames, others, plane, network)
        result.append(turned or estimate)
    return result


def mask_around(
    estimate: ObjectEstimate, frame: RgbdFrame, others: Sequence[SurfaceSamples]
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of a mug and its handle, wherever that is: measured around the axis of its body.

    Args:
        estimate: Mug at its pose.
        frame: Image with its camera pose.
        others: Surfaces of other objects in the world frame.
    """
    assert frame.T_world_camera is not None
    vertices, axis = estimate.mesh.vertices, body_axis(estimate)
    reach = 0.5 * float(np.ptp(vertices[:, 1])) + HANDLE
    low, high = float(vertices[:, 2].min()), float(vertices[:, 2].max())
    T_object_camera = invert(estimate.T_world_object) @ frame.T_world_camera
    rows, columns = _window(frame, invert(T_object_camera), axis, reach, (low, high))
    mask = np.zeros(frame.depth.shape, np.uint8)
    v, u = np.nonzero(frame.depth[rows, columns] > 0)
    v, u = v + rows.start, u + columns.start
    points = transform_points(T_object_camera, pixel_rays(frame, u, v) * frame.depth[v, u, None]) - axis
    beside = np.linalg.norm(points[:, :2], axis=1) < reach
    near = np.flatnonzero(beside & (points[:, 2] > low + _FLOOR) & (points[:, 2] < high + _ABOVE))
    world = transform_points(estimate.T_world_object, points[near] + axis)
    for other in others:
        if len(near):
            is_free = other.distance(world, limit=2 * _EXPLAINED) > _EXPLAINED
            near, world = near[is_free], world[is_free]
    mask[v[near], u[near]] = 1
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count < 2:
        return np.zeros(mask.shape, bool)
    return np.asarray(labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()))


def _window(
    frame: RgbdFrame,
    T_camera_object: Float[np.ndarray, "4 4"],
    axis: Float[np.ndarray, "3"],
    reach: float,
    heights: tuple[float, float],
) -> tuple[slice, slice]:
    """Return the rows and columns that hold the box [m] around the axis of a mug; none behind the camera."""
    corners = np.array([[x, y, z] for x in (-reach, reach) for y in (-reach, reach) for z in heights]) + axis
    points = transform_points(T_camera_object, corners)
    if points[:, 2].min() < 0.05:
        return slice(0, 0), slice(0, 0)
    camera = frame.intrinsics
    u = camera.fx * points[:, 0] / points[:, 2] + camera.cx
    v = camera.fy * points[:, 1] / points[:, 2] + camera.cy
    top, bottom = np.clip([v.min(), v.max() + 1], 0, camera.height).astype(int)
    left, right = np.clip([u.min(), u.max() + 1], 0, camera.width).astype(int)
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def body_axis(estimate: ObjectEstimate) -> Float[np.ndarray, "3"]:
    """Return the point [m] of the axis of a mug's body at z = 0 in its frame; the handle is along +x."""
    vertices = estimate.mesh.vertices
    radius = 0.5 * float(np.ptp(vertices[:, 1]))
    return np.array([vertices[:, 0].min() + radius, vertices[:, 1].min() + radius, 0.0])


def sure_direction(probabilities: Float[np.ndarray, "b"]) -> float | None:
    """Return the mean direction around the most probable bin; None if others are not much less probable."""
    bins = 2 * np.pi * np.arange(len(probabilities)) / len(probabilities)
    best = bins[int(probabilities.argmax())]
    offsets = (bins - best + np.pi) % (2 * np.pi) - np.pi
    near = np.abs(offsets) <= NEAR
    if probabilities[near].sum() < SURE:
        return None
    mean = best + np.average(offsets[near], weights=probabilities[near])
    return wrapped_angle(float(mean))
