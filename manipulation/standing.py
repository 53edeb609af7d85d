"""Conversion of object estimates to standing objects: upright, on the support, origin below the body axis."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manipulation.cross_sections import extent, fit_circle
from manipulation.errors import PlanningError
from manipulation.types import StandingObject
from perception.geometry import nearest_yaw, pose_from_yaw
from perception.mesh_sections import cross_section
from perception.types import Category, ObjectEstimate, SupportPlane

HANDLE_HALF_ANGLE = np.deg2rad(60.0)  # half the sector around a mug's +x that is excluded from its body
# Heights [m] of an object's base over the support from which on it stands on something else: where perception
# found that, and where it did not, and the lowest part of the shape may be missing.
RAISED, RAISED_ALONE = 0.01, 0.03
LEANING = np.deg2rad(8.0)  # tilt from which on an object on another one leans; less is an error of the fit
_ROUND_TOLERANCE = 0.12  # largest relative variation of the width over azimuth of a round body


def to_standing(estimate: ObjectEstimate, support: SupportPlane | None = None) -> StandingObject:
    """Return the object in its stand frame.

    Yaw and horizontal position are those of the estimate; its tilt is discarded and the origin is placed on
    the support plane, because the object was observed standing; below an object that stands on another one,
    it is at the object's base. One that leans there, as a mug in a bowl, keeps its tilt.

    Raises:
        PlanningError: the mesh is empty, or the object is tilted by more than 45 degrees.
    """
    _require_mesh(estimate)
    vertices, faces = estimate.mesh.vertices, estimate.mesh.faces
    support = support or SupportPlane()
    T = estimate.T_world_object
    tilt = float(np.arccos(np.clip(T[:3, 2] @ support.normal, -1.0, 1.0)))
    if tilt > np.deg2rad(45):
        raise PlanningError(f"{estimate.name} lies on its side (tilt {np.rad2deg(tilt):.0f} degrees)")
    if estimate.rests_on is not None and tilt > LEANING:
        return to_lying(estimate)
    axis = body_axis(vertices, faces, estimate.category)
    in_stand = vertices - np.array([*axis, 0.0])
    is_round = estimate.category != "mug" and _is_round(in_stand, faces)
    turn = 0.0 if is_round or estimate.category == "mug" else _narrow_direction(in_stand, faces)
    yaw = nearest_yaw(T)
    origin = pose_from_yaw(yaw, T[:3, 3]) @ np.array([*axis, 0.0, 1.0])
    origin = origin[:3]
    height = T[2, 3]
    origin[2] = support.offset / support.normal[2] - support.normal[:2] @ origin[:2] / support.normal[2]
    in_stand = in_stand @ pose_from_yaw(turn, np.zeros(3))[:3, :3]
    in_stand[:, 2] += height - origin[2]
    base = float(in_stand[:, 2].min())
    if base > (RAISED_ALONE if estimate.rests_on is None else RAISED):
        in_stand[:, 2] -= base
        origin[2] += base
    return StandingObject(
        id=estimate.id,
        name=estimate.name,
        category=estimate.category,
        vertices=in_stand,
        faces=faces,
        T_world_stand=pose_from_yaw(yaw + turn, origin),
        size=estimate.size,
        is_round=is_round,
        sigma=np.zeros(0) if estimate.surface_sigma is None else estimate.surface_sigma,
    )


def to_lying(estimate: ObjectEstimate) -> StandingObject:
    """Return an object in any orientation, in the stand frame that it would have upright.

    ``T_world_stand`` is its full pose: the frame's z is the object's axis, its origin the centre of its base.

    Raises:
        PlanningError: the mesh is empty.
    """
    _require_mesh(estimate)
    vertices, faces = estimate.mesh.vertices, estimate.mesh.faces
    base = np.array([*body_axis(vertices, faces, estimate.category), vertices[:, 2].min()])
    in_stand = vertices - base
    is_round = estimate.category != "mug" and _is_round(in_stand, faces)
    turn = 0.0 if is_round or estimate.category == "mug" else _narrow_direction(in_stand, faces)
    T_object_stand = pose_from_yaw(turn, base)
    return StandingObject(
        id=estimate.id,
        name=estimate.name,
        category=estimate.category,
        vertices=in_stand @ T_object_stand[:3, :3],
        faces=faces,
        T_world_stand=estimate.T_world_object @ T_object_stand,
        size=estimate.size,
        is_round=is_round,
        sigma=np.zeros(0) if estimate.surface_sigma is None else estimate.surface_sigma,
    )


def _require_mesh(estimate: ObjectEstimate) -> None:
    if len(estimate.mesh.vertices) < 4 or len(estimate.mesh.faces) < 4:
        raise PlanningError(f"{estimate.name} has an empty mesh: re-observe or exclude it")


def body_axis(
    vertices: Float[np.ndarray, "v 3"], faces: np.ndarray, category: Category
) -> Float[np.ndarray, "2"]:
    """Return (x, y) [m] of the body's vertical axis; for mugs, of a circle fitted without the handle."""
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    if category != "mug":
        return 0.5 * (vertices[:, :2].min(axis=0) + vertices[:, :2].max(axis=0))
    middle = 0.5 * (vertices[:, 1].min() + vertices[:, 1].max())
    radius = np.ptp(vertices[:, 1]) / 2
    center = np.array([vertices[:, 0].min() + radius, middle])
    points = np.concatenate(
        [cross_section(vertices, faces, low + k * (high - low)).reshape(-1, 2) for k in (0.6, 0.75, 0.9)]
    )
    for _ in range(3):
        relative = points - center
        distance = np.linalg.norm(relative, axis=1)
        body = np.abs(np.arctan2(relative[:, 1], relative[:, 0])) > HANDLE_HALF_ANGLE
        outer = distance > 0.9 * np.median(distance[body]) if body.any() else body
        if (body & outer).sum() < 12:
            break
        fitted, fitted_radius = fit_circle(points[body & outer])
        if np.linalg.norm(fitted - center) > 0.3 * radius or not 0.5 < fitted_radius / radius < 1.5:
            break
        center = fitted
    return center


def split_handle(
    vertices: Float[np.ndarray, "v 3"], category: Category
) -> tuple[Float[np.ndarray, "_k 3"], ...]:
    """Return the vertices (stand frame) of body and handle of a mug; one part for other categories."""
    if category != "mug":
        return (vertices,)
    radius = np.ptp(vertices[:, 1]) / 2
    beyond = vertices[:, 0] > 0.95 * radius
    if beyond.sum() < 8 or np.ptp(vertices[beyond, 0]) < 1e-3:
        return (vertices,)
    width = np.abs(vertices[beyond, 1]).max() + 1e-3
    low, high = vertices[beyond, 2].min(), vertices[beyond, 2].max()
    arm = (vertices[:, 0] > 0.6 * radius) & (np.abs(vertices[:, 1]) <= width)
    arm &= (vertices[:, 2] >= low - 0.01) & (vertices[:, 2] <= high + 0.01)
    return (vertices[~beyond], vertices[arm | beyond])


def _widths(vertices: np.ndarray, faces: np.ndarray, azimuths: np.ndarray) -> np.ndarray:
    """Return the widths [m] of the cross-section at mid height along the azimuths; empty if it is empty."""
    middle = cross_section(vertices, faces, 0.5 * (vertices[:, 2].min() + vertices[:, 2].max()) + 1e-5)
    return np.array([e.width for e in (extent(middle, azimuth) for azimuth in azimuths) if e is not None])


def _is_round(vertices: np.ndarray, faces: np.ndarray) -> bool:
    widths = _widths(vertices, faces, np.arange(0.0, np.pi, np.pi / 8))
    return len(widths) == 0 or bool(np.ptp(widths) <= _ROUND_TOLERANCE * widths.max())


def _narrow_direction(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the direction [rad] along which the body is narrowest."""
    azimuths = np.deg2rad(np.arange(0.0, 180.0, 3.0))
    return float(azimuths[np.argmin(_widths(vertices, faces, azimuths))])
