"""Entries of ``scene_camera.json`` in a scan folder, as in BOP: intrinsics, and poses in millimetres."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from perception.errors import InvalidInputError
from perception.io.arrays import numbers_of
from perception.types import CameraIntrinsics, RgbdFrame

DEPTH_SCALE = 0.1  # of the depth images written here: a tenth of a millimetre, up to 6.5 m
MIN_TRANSLATION = 10.0  # [mm] length below which all translations together are suspicious
MAX_ASPECT = 1.5  # of the pixels: focal lengths of images that were stretched differ by 4/3
MAX_DISTANCE = 100.0  # [m] of a camera from the origin
MAX_TIME = 1e11  # [s]: the year 5138; larger ones are in other units
MAX_NUMBER = 1e9  # of a camera: 1000 km in millimetres; larger ones overflow


def camera_entry(frame: RgbdFrame) -> dict[str, Any]:
    """Return the entry of a frame whose depth image has the unit DEPTH_SCALE."""
    entry: dict[str, Any] = {
        "cam_K": frame.intrinsics.matrix.ravel().tolist(),
        "depth_scale": DEPTH_SCALE,
        "time": float(frame.time),
    }
    if frame.T_world_camera is not None:
        T_camera_world = np.linalg.inv(frame.T_world_camera)
        entry["cam_R_w2c"] = T_camera_world[:3, :3].ravel().tolist()
        entry["cam_t_w2c"] = (1000 * T_camera_world[:3, 3]).tolist()
    return entry


def check_camera(frame: RgbdFrame) -> None:
    """Raise InvalidInputError if a scan with the frame would be refused for its camera or time."""
    _check_focal_lengths(frame.intrinsics)
    if not abs(frame.time) <= MAX_TIME:
        raise InvalidInputError(f"times are in seconds, at most {MAX_TIME:g}: divide nanoseconds by 1e9")
    if frame.T_world_camera is not None:
        _check_position(frame.T_world_camera)


def read_intrinsics(entry: Any, width: int, height: int) -> CameraIntrinsics:
    """Return the intrinsics of an entry for an image of a size; raise InvalidInputError."""
    fx, skew, cx, below, fy, cy, *last = read_numbers(entry, "cam_K", 9)
    if skew != 0 or below != 0 or last != [0, 0, 1]:
        raise InvalidInputError(
            "cam_K must be [fx, 0, cx, 0, fy, cy, 0, 0, 1]: undistort and rectify the images"
        )
    intrinsics = CameraIntrinsics(width, height, fx, fy, cx, cy)
    _check_focal_lengths(intrinsics)
    return intrinsics


def read_pose(entry: Any) -> Float[np.ndarray, "4 4"]:
    """Return T_world_camera from the rotation and translation of an entry; raise InvalidInputError."""
    if "cam_R_w2c" not in entry or "cam_t_w2c" not in entry:
        raise InvalidInputError("has no pose although other images have; give all or none")
    R_camera_world = read_numbers(entry, "cam_R_w2c", 9).reshape(3, 3)
    t_camera_world = read_numbers(entry, "cam_t_w2c", 3) / 1000
    if (
        not np.allclose(R_camera_world @ R_camera_world.T, np.eye(3), atol=1e-3)
        or np.linalg.det(R_camera_world) < 0
    ):
        raise InvalidInputError("cam_R_w2c is not a rotation matrix")
    u, _, vt = np.linalg.svd(R_camera_world)  # nearest rotation: files hold rounded numbers
    T = np.eye(4)
    T[:3, :3] = (u @ vt).T
    T[:3, 3] = -T[:3, :3] @ t_camera_world
    _check_position(T)
    return T


def read_numbers(entry: Any, key: str, count: int) -> np.ndarray:
    """Return so many numbers of an entry, which may be nested lists; raise InvalidInputError."""
    value = entry.get(key) if isinstance(entry, dict) else None
    try:
        numbers = numbers_of(value).ravel()
    except ValueError:
        numbers = np.zeros(0)
    if numbers.size != count or not (np.abs(numbers) <= MAX_NUMBER).all():  # NaN fails as well
        what = "a finite number" if count == 1 else f"{count} finite numbers"
        raise InvalidInputError(f"{key} must be {what} of at most {MAX_NUMBER:g} in magnitude")
    return numbers


def suspicion_of_metres(entries: Sequence[Any]) -> str | None:
    """Return a warning if the translations are so small that they are probably in metres."""
    translations = [np.asarray(entry["cam_t_w2c"], dtype=np.float64).ravel() for entry in entries]
    longest = max(float(np.linalg.norm(translation)) for translation in translations)
    if not 0 < longest < MIN_TRANSLATION:  # 0: the world is the camera frame
        return None
    return (
        f"the translations cam_t_w2c are at most {longest:.3g} mm long, probably they are in metres: "
        "multiply them by 1000"
    )


def _check_focal_lengths(camera: CameraIntrinsics) -> None:
    if not (
        0.05 * camera.width < camera.fx < 50 * camera.width
        and 1 / MAX_ASPECT < camera.fx / camera.fy < MAX_ASPECT
    ):
        raise InvalidInputError(
            f"focal lengths {camera.fx:g}, {camera.fy:g} px are implausible for an image "
            f"{camera.width} px wide"
        )


def _check_position(T_world_camera: Float[np.ndarray, "4 4"]) -> None:
    distance = float(np.linalg.norm(T_world_camera[:3, 3]))
    if distance > MAX_DISTANCE:
        raise InvalidInputError(
            f"the camera is {distance:.3g} m from the origin, at most {MAX_DISTANCE:g} m are allowed: check "
            "the unit, and give coordinates of the scene, not of a map"
        )
