"""Hand-eye calibration of a wrist camera: a TOML file with its pose in the tool frame.

T_tcp_camera = [[0.0, -1.0, 0.0, 0.065], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -0.051], [0.0, 0.0, 0.0, 1.0]]
residual_position = 0.0008      # [m], root mean square over the calibration's images
residual_rotation = 0.003       # [rad]
calibrated = 2026-11-20
"""

from __future__ import annotations

import datetime
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from jaxtyping import Float
from msgspec import Meta

from manipulation.errors import ManipulationError
from perception.errors import InvalidInputError
from perception.io.files import read_text
from perception.types import check_rigid

# Above these residuals the standard deviation of a placed object exceeds the clearances of planning.
MAX_POSITION, MAX_ROTATION = 0.005, 0.02
MAX_DISTANCE = 1.0  # [m] of the camera from the tool frame

_Row = Annotated[list[float], Meta(min_length=4, max_length=4)]


class CalibrationError(ManipulationError):
    """The calibration file cannot be used; the message names the entry and the remedy."""


class _Entries(msgspec.Struct, forbid_unknown_fields=True):
    T_tcp_camera: Annotated[list[_Row], Meta(min_length=4, max_length=4)]
    residual_position: Annotated[float, Meta(ge=0)]
    residual_rotation: Annotated[float, Meta(ge=0)]
    calibrated: datetime.date


@dataclass(frozen=True)
class HandEye:
    """Pose of the wrist camera in the tool frame.

    Attributes:
        T_tcp_camera: (4, 4) pose of the camera (OpenCV axes) in the frame between the pads.
        residual_position, residual_rotation: root mean square of the calibration in [m], [rad].
        calibrated: date of the calibration.
    """

    T_tcp_camera: Float[np.ndarray, "4 4"]
    residual_position: float
    residual_rotation: float
    calibrated: datetime.date


def read_hand_eye(path: Path) -> HandEye:
    """Read a calibration file.

    Raises:
        CalibrationError: the file is missing or malformed, its matrix is no rigid motion, or its residual is
            too large for grasping.
    """
    remedy = "see docs/real_arm.md for the entries"
    try:
        entries = msgspec.convert(tomllib.loads(read_text(path)), _Entries)
        T = check_rigid(np.array(entries.T_tcp_camera), "T_tcp_camera")
    except OSError as error:
        raise CalibrationError(f"{path}: {error.strerror}; give the file of a hand-eye calibration") from None
    except (ValueError, RecursionError, msgspec.ValidationError, InvalidInputError) as error:  # TOML, UTF-8
        raise CalibrationError(f"{path}: {error}; {remedy}") from None
    distance = float(np.linalg.norm(T[:3, 3]))
    if distance > MAX_DISTANCE:
        raise CalibrationError(
            f"{path}: the camera is {distance:.3g} m from the tool frame, at most {MAX_DISTANCE:g} m are "
            "allowed: give metres"
        )
    position, rotation = entries.residual_position, entries.residual_rotation
    if position > MAX_POSITION or rotation > MAX_ROTATION:
        found = f"{1e3 * position:.1f} mm and {np.rad2deg(rotation):.2f} degrees"
        limits = f"{1e3 * MAX_POSITION:g} mm, {np.rad2deg(MAX_ROTATION):.1f} degrees"
        raise CalibrationError(
            f"{path}: a residual of {found} is too large to grasp by ({limits}): calibrate again"
        )
    return HandEye(T, position, rotation, entries.calibrated)
