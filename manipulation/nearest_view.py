"""Camera postures of arms that reach a viewpoint only approximately: five joints, or a wrist of short range.

The posture minimises, over the joint positions within their limits, the angle of the target to the optical
axis, the relative error of the distance, and the deviation of the viewing direction, each over a tolerance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from manipulation.kinematics import Kinematics

FULL_POSE = 6  # joints from which on an arm reaches any pose near by
_CENTRED = np.deg2rad(6.0)  # angle of the target to the optical axis
_NEAR = 0.15  # relative error of the distance
_ELEVATED = 0.2  # error of the elevation in [rad]
_SIDEWAYS = 0.8  # error of the azimuth in [rad], times the cosine of the elevation
NEAREST = 0.26  # [m] least distance: nearer, tall objects are cut off, and depth cameras fail
MAX_OFF_AXIS = np.deg2rad(12.0)
DISTANCES = (0.6, 1.35)  # range of the distance, relative to the wanted one


def nearest_view(
    kinematics: Kinematics,
    target: Float[np.ndarray, "3"],
    camera: Float[np.ndarray, "3"],
    seeds: Sequence[Float[np.ndarray, "n"]],
    margin: float,
) -> Float[np.ndarray, "n"] | None:
    """Return the posture [rad] whose camera sees a target most nearly as from a given position.

    Args:
        kinematics: the arm.
        target: point to look at in [m].
        camera: wanted position of the camera in [m]; if too near, one farther away in the same direction.
        seeds: start postures.
        margin: distance from the joint limits in [rad].

    Returns:
        The posture; None if the target is not near the middle of the image at a similar distance.
    """
    low, high = kinematics.lower + margin, kinematics.upper - margin
    wanted = camera - target
    elevation, azimuth = np.arctan2(wanted[2], np.hypot(*wanted[:2])), np.arctan2(wanted[1], wanted[0])
    distance = max(float(np.linalg.norm(wanted)), NEAREST)

    def residuals(q: Float[np.ndarray, "n"]) -> Float[np.ndarray, "5"]:
        off_axis, away = _view(kinematics, q, target)
        far = float(np.linalg.norm(away))
        turn = float(np.angle(np.exp(1j * (np.arctan2(away[1], away[0]) - azimuth))))
        others = (
            (far / distance - 1) / _NEAR,
            (np.arcsin(away[2] / far) - elevation) / _ELEVATED,
            turn * np.cos(elevation) / _SIDEWAYS,
        )
        return np.array([*(off_axis / _CENTRED), *others])

    starts = [np.clip(seed, low + 1e-3, high - 1e-3) for seed in seeds]
    found = [least_squares(residuals, start, bounds=(low, high), max_nfev=60) for start in starts]
    best = min(found, key=lambda result: result.cost).x
    off_axis, away = _view(kinematics, best, target)
    share = float(np.linalg.norm(away)) / distance
    seen = np.linalg.norm(off_axis) < MAX_OFF_AXIS and DISTANCES[0] < share < DISTANCES[1]
    return best if seen else None


def view_angle(
    kinematics: Kinematics,
    q: Float[np.ndarray, "n"],
    target: Float[np.ndarray, "3"],
    camera: Float[np.ndarray, "3"],
) -> float:
    """Return the angle [rad] at the target between the camera in a posture and a wanted position of it."""
    away, wanted = _view(kinematics, q, target)[1], camera - target
    cosine = float(away @ wanted / (np.linalg.norm(away) * np.linalg.norm(wanted)))
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _view(
    kinematics: Kinematics, q: Float[np.ndarray, "n"], target: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "3"]]:
    """Return the angles of the target to the optical axis [rad], and the camera's position relative to it."""
    T = kinematics.forward(q, "camera")
    x, y, z = T[:3, :3].T @ (target - T[:3, 3])
    return np.array([np.arctan2(x, z), np.arctan2(y, z)]), T[:3, 3] - target
