"""Where a recording happens: what it stands on, and where to look at it from.

A recorded cell brings its own floor, and z is up in it. A map, or objects from somebody's images, may lie
anywhere and lean any way: there the objects themselves say where up is, and what they stand on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from app.runs.finished_run import support_of
from app.runs.replay import Recorder
from app.viewer.snapshot import CAMERA
from app.viewer.timeline import matrix

SCENERY = "world"  # the body that stands fast
_CELL = (1.62, -0.88, 1.0), (0.40, -0.02, 0.14)  # of the view of a cell: position and target [m]
FIELD_OF_VIEW = 0.80  # [rad]
AWAY, ASIDE, ABOVE = 1.6, np.deg2rad(50), np.deg2rad(33)  # the first view: times as far, beside, above
AHEAD = 0.5  # [m] before a camera is what it looks at, where nothing was found


@dataclass(frozen=True)
class Surroundings:
    """What the viewer puts around a recording.

    Attributes:
        T_world_ground: frame on the support in the middle of everything, z up.
        position, target: of the first view [m].
        known: whether the recording brings the floor itself.
    """

    T_world_ground: Float[np.ndarray, "4 4"]
    position: Float[np.ndarray, "3"]
    target: Float[np.ndarray, "3"]
    known: bool

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        return self.T_world_ground[:3, 2]


def surroundings_of(recorder: Recorder) -> Surroundings:
    """Ground and first view of a recording."""
    cameras, known = _cameras(recorder), SCENERY in recorder.meshes
    if known or not (len(cameras) or recorder.objects):
        position, target = (np.array(point) for point in _CELL)
        return Surroundings(np.eye(4), position, target, known)
    if recorder.objects:
        plane = support_of(recorder.objects, ())
        middle = np.mean([estimate.T_world_object[:3, 3] for estimate in recorder.objects], axis=0)
        up, middle = plane.normal, middle - (middle @ plane.normal - plane.offset) * plane.normal
    else:
        up = -cameras[:, :3, 1].mean(axis=0) if len(cameras) == 1 else np.array([0.0, 0.0, 1.0])
        middle = (cameras[:, :3, 3] + AHEAD * cameras[:, :3, 2]).mean(axis=0)
    T = np.eye(4)
    T[:3, :3] = Rotation.align_vectors(up[None], np.array([[0.0, 0.0, 1.0]]))[0].as_matrix()
    T[:3, 3] = middle
    recorded = cameras[0, :3, 3] if len(cameras) else T[:3, :3] @ (0.0, -0.6, 0.4) + middle
    return Surroundings(T, middle + _from_aside(T, recorded - middle), middle + 0.04 * up, known=False)


def _from_aside(T: Float[np.ndarray, "4 4"], away: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Where to look from, so that neither the camera nor its way is in between."""
    x, y, _ = T[:3, :3].T @ away
    azimuth = np.arctan2(y, x) + ASIDE
    flat = np.cos(ABOVE) * np.array([np.cos(azimuth), np.sin(azimuth), np.tan(ABOVE)])
    return AWAY * np.linalg.norm(away) * (T[:3, :3] @ flat)


def _cameras(recorder: Recorder) -> Float[np.ndarray, "n 4 4"]:
    """Known poses of the camera, of images or of a moving body."""
    poses = [frame.T_world_camera for frame in recorder.frames if frame.T_world_camera is not None]
    if not poses and CAMERA in recorder.bodies and recorder.poses:
        poses = [matrix(recorder.poses[0][recorder.bodies.index(CAMERA)])]
    return np.array(poses).reshape(-1, 4, 4)
