"""Grasps for the objects of a reconstruction, ranked, free of collisions of the hand.

No robot model is needed. Reach and collisions of the arm are left to the caller's own planner.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from manipulation.errors import ManipulationError, PlanningError
from manipulation.grasp_config import GraspConfig
from manipulation.grasps import grasp_candidates
from manipulation.hand_collision import HandBoxes, HandClearance, hand_is_free, surface_points
from manipulation.robot import GripperGeometry
from manipulation.standing import to_standing
from manipulation.types import Grasp
from perception.geometry import invert, rigid, upright_rotation
from perception.reconstruction import Reconstruction, transformed_estimate
from perception.types import ObjectEstimate, SupportPlane

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class GraspPose:
    """A grasp in the frames of the scene.

    The TCP lies between the pads, its z axis along the approach, its y axis along the closing direction.

    Attributes:
        object_id: id of the object.
        T_world_tcp: (4, 4) TCP pose in the world frame; in the camera frame if no camera pose is known.
        T_camera_tcp: (4, 4) TCP pose in the camera frame; None where the objects come from several images.
        retreat_world: (3,) unit vector along which the hand retreats; it approaches along its negative.
        grasp: the grasp in the object's stand frame, with opening, expected width when closed, and score.
    """

    object_id: int
    T_world_tcp: Float[np.ndarray, "4 4"]
    T_camera_tcp: Float[np.ndarray, "4 4"] | None
    retreat_world: Float[np.ndarray, "3"]
    grasp: Grasp

    @property
    def opening(self) -> float:
        """Distance between the pads before closing, in metres."""
        return self.grasp.opening

    @property
    def score(self) -> float:
        """Preference; higher is better."""
        return self.grasp.score

    def pregrasp(self, distance: float = 0.10) -> Float[np.ndarray, "4 4"]:
        """Return T_world_tcp at the start of a straight approach of the given length in metres."""
        T = self.T_world_tcp.copy()
        T[:3, 3] += distance * self.retreat_world
        return T


def find_grasps(
    scene: Reconstruction | ObjectEstimate | Sequence[ObjectEstimate],
    gripper: GripperGeometry = GripperGeometry(),
    T_world_camera: Float[np.ndarray, "4 4"] | None = None,
    ids: Collection[int] | None = None,
    clearance: HandClearance = HandClearance(),
) -> list[GraspPose]:
    """Find the grasps of all objects at which the open hand meets nothing, best first.

    Obstacles are the other objects of the scene and the plane that the object stands on, at the grasp and
    along the approach. Objects that do not stand upright yield no grasp; a warning is logged.

    Args:
        scene: a reconstruction; or object estimates in a world frame whose plane z = 0 supports them.
        gripper: geometry of the parallel gripper.
        T_world_camera: (4, 4) camera pose, for a reconstruction made without one.
        ids: ids of the objects to grasp; all if None.
        clearance: clearances of the hand.

    Returns:
        The grasps by descending score; empty if there is none.

    Raises:
        InvalidInputError: a camera pose is given for a reconstruction that has one.
        ManipulationError: a camera pose is given with bare estimates, or an id is not in the scene.
    """
    scene = _as_reconstruction(scene, T_world_camera)
    estimates = {estimate.id: estimate for estimate in scene.objects}
    unknown = sorted(set(ids or ()) - set(estimates))
    if unknown:
        raise ManipulationError(f"no object {unknown[0]} in the scene; its ids are {sorted(estimates)}")
    planes = {key: scene.plane_of(key) for key in (estimates if ids is None else ids)}
    found = []
    for plane in {id(plane): plane for plane in planes.values()}.values():
        keys = [key for key in planes if planes[key] is plane]
        found += _grasps_on(plane, keys, scene, gripper, clearance)
    return sorted(found, key=lambda pose: -pose.score)


def _grasps_on(
    plane: SupportPlane,
    keys: Sequence[int],
    scene: Reconstruction,
    gripper: GripperGeometry,
    clearance: HandClearance,
) -> list[GraspPose]:
    """Return the free grasps of the objects that stand on a plane, which is an obstacle as the others are."""
    T_world_plane = rigid(upright_rotation(plane.normal, 0.0), plane.offset * plane.normal)
    T_plane_world = invert(T_world_plane)
    on_plane = {estimate.id: transformed_estimate(estimate, T_plane_world) for estimate in scene.objects}
    points = {key: surface_points(estimate.mesh_world) for key, estimate in on_plane.items()}
    T_camera_world = None if scene.T_world_camera is None else invert(scene.T_world_camera)
    found = []
    for key in keys:
        others = np.concatenate([np.zeros((0, 3)), *(points[other] for other in points if other != key)])
        for grasp, T_plane_tcp, away in _free_grasps(on_plane[key], points[key], others, gripper, clearance):
            T_world_tcp = T_world_plane @ T_plane_tcp
            found.append(
                GraspPose(
                    object_id=key,
                    T_world_tcp=T_world_tcp,
                    T_camera_tcp=None if T_camera_world is None else T_camera_world @ T_world_tcp,
                    retreat_world=T_world_plane[:3, :3] @ away,
                    grasp=grasp,
                )
            )
    return found


def _as_reconstruction(
    scene: Reconstruction | ObjectEstimate | Sequence[ObjectEstimate],
    T_world_camera: Float[np.ndarray, "4 4"] | None,
) -> Reconstruction:
    if isinstance(scene, Reconstruction):
        return scene if T_world_camera is None else scene.in_world(T_world_camera)
    if T_world_camera is not None:
        raise ManipulationError(
            "T_world_camera needs a Reconstruction: bare object estimates are taken to be in the world frame"
        )
    objects = (scene,) if isinstance(scene, ObjectEstimate) else tuple(scene)
    return Reconstruction(objects, SupportPlane())


def _free_grasps(
    estimate: ObjectEstimate,
    own: Float[np.ndarray, "_n 3"],
    others: Float[np.ndarray, "_m 3"],
    gripper: GripperGeometry,
    clearance: HandClearance,
) -> list[tuple[Grasp, Float[np.ndarray, "4 4"], Float[np.ndarray, "3"]]]:
    """Return grasp, TCP pose and retreat direction in the plane frame; the palm must not meet the object."""
    try:
        item = to_standing(estimate)
    except PlanningError as error:
        logger.warning("no grasps: %s", error)
        return []
    free = []
    for grasp in grasp_candidates(item, GraspConfig(gripper=gripper)).grasps:
        T_plane_tcp = item.T_world_stand @ grasp.T_stand_open
        away = item.T_world_stand[:3, :3] @ grasp.away
        boxes = HandBoxes.of(gripper, grasp.opening, clearance.hand_length)
        boxes = boxes.moved(gripper.pads_middle(grasp.opening))
        own_tcp = (own - T_plane_tcp[:3, 3]) @ T_plane_tcp[:3, :3]
        if not boxes.palm.contain(own_tcp) and hand_is_free(boxes, T_plane_tcp, away, others, clearance):
            free.append((grasp, T_plane_tcp, away))
    return free
