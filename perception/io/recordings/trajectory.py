"""Camera trajectories in the TUM RGB-D format: one pose per line, ``time tx ty tz qx qy qz qw`` [s, m].

https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from perception.errors import InvalidInputError
from perception.io.files import read_text, write_atomically
from perception.io.scan_cameras import MAX_TIME

MAX_POSITION = 1e6  # [m]
MAX_LENGTH_ERROR = 0.05  # of a quaternion: files hold rounded numbers


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time.

    Attributes:
        times: (n,) times in seconds.
        Ts_world_camera: (n, 4, 4) camera poses.
    """

    times: Float[np.ndarray, "n"]
    Ts_world_camera: Float[np.ndarray, "n 4 4"]

    @staticmethod
    def of(times: Sequence[float], poses: Sequence[Float[np.ndarray, "4 4"]]) -> Trajectory:
        """Create a trajectory from sequences of equal length."""
        return Trajectory(np.array(times, float), np.array(poses, float).reshape(-1, 4, 4))

    def nearest(self, time: float, tolerance: float) -> Float[np.ndarray, "4 4"] | None:
        """Return the pose nearest in time; None if it is more than ``tolerance`` [s] away."""
        apart = np.abs(self.times - time)
        index = int(apart.argmin()) if len(apart) else -1
        return self.Ts_world_camera[index] if index >= 0 and apart[index] <= tolerance else None


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory, one pose per line; the quaternion's scalar part is last."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time, T in zip(trajectory.times, trajectory.Ts_world_camera):
        numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        lines.append(f"{time:.6f} " + " ".join(f"{x:.9f}" for x in numbers))
    write_atomically(path, "\n".join(lines) + "\n")


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory; empty lines and comments (#) are skipped.

    Raises:
        InvalidInputError: The file is missing, or a line is not a pose; the message names the line.
    """
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInputError(f"{path} cannot be read ({error}): give a TUM trajectory") from None
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            rows.append(_numbers(line))
        except ValueError as error:
            raise InvalidInputError(
                f"{path}, line {number} is not a pose ({error}): time tx ty tz qx qy qz qw"
            ) from None
    numbers = np.array(rows, float).reshape(-1, 8)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if rows:
        poses[:, :3, :3] = Rotation.from_quat(numbers[:, 4:]).as_matrix()
    poses[:, :3, 3] = numbers[:, 1:4]
    return Trajectory(numbers[:, 0], poses)


def _numbers(line: str) -> list[float]:
    """Return time, position and quaternion of a line; raise ValueError."""
    numbers = [float(word) for word in line.split()]
    if len(numbers) != 8:
        raise ValueError(f"{len(numbers)} numbers instead of 8")
    if not all(map(math.isfinite, numbers)):
        raise ValueError("it is not finite")
    if abs(numbers[0]) > MAX_TIME:
        raise ValueError(f"its time is no number of seconds up to {MAX_TIME:g}")
    if max(map(abs, numbers[1:4])) > MAX_POSITION:
        raise ValueError(f"its position is above {MAX_POSITION:g} m")
    if abs(math.hypot(*numbers[4:]) - 1) > MAX_LENGTH_ERROR:
        raise ValueError("its quaternion is not of length 1")
    return numbers
