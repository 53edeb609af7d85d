"""The result of reconstructing a scene: its objects, the plane they stand on, and the frame of both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from perception.errors import InvalidInputError
from perception.types import ObjectDetection, ObjectEstimate, RejectedObject, SupportPlane, check_rigid

_TRANSLATION = slice(19, 22)  # of the covariance's 25 parameters: code 16, rotation 3, translation 3, scale 3


@dataclass(frozen=True)
class Reconstruction:
    """Objects reconstructed from one RGB-D image or several.

    Poses, meshes and the plane are in the world frame. Where no camera pose is known, the world is the frame
    of the (only) camera: x right, y down, z forward; ``posed`` is then False.

    Attributes:
        objects: the object estimates, by ascending id.
        plane: the main support plane.
        detections: for each image its detections, ``instance_id`` being the id of the object.
        T_world_camera: (4, 4) camera pose of a single image, identity if unknown; None for several.
        posed: whether the camera poses are known.
        rejected: detected objects that were left out, each with the reason.
        planes: the planes that ``ObjectDetection.support`` numbers, the main one first; empty for that alone.
    """

    objects: tuple[ObjectEstimate, ...]
    plane: SupportPlane
    detections: tuple[tuple[ObjectDetection, ...], ...] = ()
    T_world_camera: Float[np.ndarray, "4 4"] | None = None
    posed: bool = True
    rejected: tuple[RejectedObject, ...] = ()
    planes: tuple[SupportPlane, ...] = ()

    def plane_of(self, object_id: int) -> SupportPlane:
        """Return the plane that an object stands on: the main one unless a detection names another."""
        supports = [d.support for image in self.detections for d in image if d.instance_id == object_id]
        return self.planes[supports[0]] if self.planes and supports else self.plane

    def in_world(self, T_world_camera: Float[np.ndarray, "4 4"]) -> Reconstruction:
        """Return the reconstruction in the world frame, given the camera pose it was made without.

        The yaw distributions of the detections, which refer to the axes of the old frame, are dropped.

        Raises:
            InvalidInputError: the reconstruction is in the world frame already, or the pose is not rigid.
        """
        if self.posed:
            raise InvalidInputError(
                "the reconstruction is in the world frame already: leave out T_world_camera here, "
                "or leave it out of the reconstruction"
            )
        T = check_rigid(T_world_camera, "T_world_camera")
        return Reconstruction(
            objects=tuple(transformed_estimate(estimate, T) for estimate in self.objects),
            plane=_transformed_plane(self.plane, T),
            detections=tuple(
                tuple(replace(detection, yaw_probabilities=np.zeros(0)) for detection in image)
                for image in self.detections
            ),
            T_world_camera=T,
            rejected=self.rejected,
            planes=tuple(_transformed_plane(plane, T) for plane in self.planes),
        )


def _transformed_plane(plane: SupportPlane, T: Float[np.ndarray, "4 4"]) -> SupportPlane:
    normal = T[:3, :3] @ plane.normal
    return SupportPlane(normal, float(plane.offset + normal @ T[:3, 3]))


def transformed_estimate(estimate: ObjectEstimate, T: Float[np.ndarray, "4 4"]) -> ObjectEstimate:
    """Return the estimate mapped by the rigid motion ``T``.

    Shape, scale and the deviations along the normals are invariant. In the covariance only the translation,
    which is in world axes, rotates; the rotation is a perturbation in the object frame.
    """
    covariance = estimate.covariance
    if covariance is not None:
        jacobian = np.eye(len(covariance))
        jacobian[_TRANSLATION, _TRANSLATION] = T[:3, :3]
        covariance = jacobian @ covariance @ jacobian.T
    return replace(estimate, T_world_object=T @ estimate.T_world_object, covariance=covariance)
