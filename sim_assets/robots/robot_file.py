"""Robot files: TOML with the path of an arm's MJCF and the names of its parts.

``sixaxis/robot.toml`` is an example with every entry explained.
"""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from manipulation.robot import ArmDescription, GripperGeometry
from perception.errors import InvalidInputError
from perception.io.files import read_text
from sim_assets.errors import RobotFileError
from sim_assets.robots.mounting import PREFIX, Frame, Mount, add_to_scene, planning_mjcf
from sim_assets.robots.named_parts import check_parts, compiled
from sim_assets.robots.simulated_arm import SimulatedArm

MAX_NUMBER = 1e6  # of any entry
MIN_LIMIT = 1e-3  # of velocity [rad/s], acceleration [rad/s²] and jerk [rad/s³]: slower arms never arrive
MAX_DISTANCE = 10.0  # of the base from the origin, along each axis [m]
_TCP, _CAMERA = "nodeslam_tcp", "nodeslam_camera"  # sites that a robot file gives by their poses
_GEOMETRY = [field.name for field in fields(GripperGeometry)]


def read_robot(path: Path, shipped: Sequence[str] = ()) -> SimulatedArm:
    """Load the arm that a robot file describes and check it against its MJCF.

    Args:
        path: path of the robot file.
        shipped: names of the shipped arms, for the message about a missing file.

    Raises:
        RobotFileError: an entry or part is missing or invalid.
    """
    top = _Table(path, "", _parsed(path, shipped))
    arm, gripper, camera = (top.table(name) for name in ("arm", "gripper", "camera"))
    mjcf = path.parent / top.text("mjcf")
    joints = arm.names("joints")
    count = len(joints)
    actuators = arm.names("actuators", count)
    home = arm.numbers("home", count)
    velocity, acceleration, jerk = (arm.limits(name, count) for name in ("velocity", "acceleration", "jerk"))
    base = Frame(arm.numbers("base", 3, (0.0, 0.0, 0.0), MAX_DISTANCE), _about_z(arm.number("base_yaw", 0.0)))
    fingers = gripper.names("joints", 2)
    geometry = GripperGeometry(
        **{name: gripper.positive(name) for name in _GEOMETRY if name == "max_width" or name in gripper}
    )
    closed = gripper.number("closed")
    tcp, tcp_mount = gripper.site("tcp", _TCP)
    optical, camera_mount = camera.site("site", _CAMERA)
    mount = Mount(mjcf, base, optical, fingers, tuple(m for m in (tcp_mount, camera_mount) if m is not None))
    fovy = camera.positive("fovy", 179.0)
    robot = SimulatedArm(
        description=ArmDescription(
            mjcf="",
            joint_names=joints,
            finger_joint_names=(fingers[0], fingers[1]),
            tcp_site=tcp,
            camera_site=optical,
            q_home=home,
            velocity_limit=velocity,
            acceleration_limit=acceleration,
            jerk_limit=jerk,
            gripper=geometry,
        ),
        add=functools.partial(add_to_scene, mount, fovy=fovy),
        actuators=actuators,
        gripper_actuator=gripper.text("actuator"),
        open=gripper.number("open"),
        closed=closed,
        press=gripper.number("press", closed),
        fovy=fovy,
    )
    for table in (top, arm, gripper, camera):
        table.refuse_others()
    model = compiled(path, mount)
    check_parts(path, model, robot)
    return _as_in_scenes(robot, planning_mjcf(mount, model))


def _as_in_scenes(robot: SimulatedArm, mjcf: str) -> SimulatedArm:
    """Return the arm with the names of its parts in scenes."""
    arm = robot.description
    first, second = arm.finger_joint_names
    return replace(
        robot,
        description=replace(
            arm,
            mjcf=mjcf,
            joint_names=tuple(PREFIX + name for name in arm.joint_names),
            finger_joint_names=(PREFIX + first, PREFIX + second),
            tcp_site=PREFIX + arm.tcp_site,
            camera_site=PREFIX + arm.camera_site,
        ),
        actuators=tuple(PREFIX + name for name in robot.actuators),
        gripper_actuator=PREFIX + robot.gripper_actuator,
    )


def _parsed(path: Path, shipped: Sequence[str]) -> dict[str, Any]:
    remedy = f"give a robot file (FILE.toml) or one of {', '.join(shipped)}"
    try:
        return tomllib.loads(read_text(path))
    except FileNotFoundError:
        raise RobotFileError(
            f"--robot {path} is no robot file (FILE.toml) and none of {', '.join(shipped)}"
        ) from None
    except InvalidInputError as error:
        raise RobotFileError(f"--robot {error}: {remedy}") from None
    except OSError as error:
        raise RobotFileError(f"--robot {path} cannot be read ({error.strerror}): {remedy}") from None
    except (ValueError, RecursionError) as error:  # TOML, UTF-8, integers of thousands of digits, depth
        raise RobotFileError(f"{path} cannot be read as TOML: {error}") from None


def _about_z(angle: float) -> np.ndarray:
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


@dataclass
class _Table:
    """A table of a robot file; every entry is mandatory, and unknown entries are errors."""

    path: Path
    name: str
    entries: dict[str, Any]

    def __post_init__(self) -> None:
        self._known: set[str] = set()

    def __contains__(self, key: str) -> bool:
        return key in self.entries

    def table(self, key: str) -> _Table:
        entries = self._take(key)
        if not isinstance(entries, dict):
            raise RobotFileError(f"{self.path}: [{key}] must be a table")
        return _Table(self.path, key, entries)

    def text(self, key: str) -> str:
        value = self._take(key)
        if not isinstance(value, str) or not value:
            raise self._wrong(key, "a name in quotes")
        return value

    def names(self, key: str, count: int | None = None) -> tuple[str, ...]:
        """Return ``count`` different names."""
        values = self._take(key)
        if not isinstance(values, list) or not values or not all(isinstance(v, str) and v for v in values):
            raise self._wrong(key, "a list of names in quotes")
        self._check_count(key, values, count)
        if len(set(values)) < len(values):
            raise self._wrong(key, "a list of different names")
        return tuple(values)

    def number(self, key: str, default: float | None = None) -> float:
        value = self._take(key, default)
        if not _is_number(value, MAX_NUMBER):
            raise self._wrong(key, f"a finite number of at most {MAX_NUMBER:g} in magnitude")
        return float(value)

    def positive(self, key: str, most: float = np.inf) -> float:
        value = self.number(key)
        if not 0 < value <= most:
            raise self._wrong(key, f"above 0 and at most {most:g}" if np.isfinite(most) else "above 0")
        return value

    def numbers(
        self, key: str, count: int, default: Sequence[float] | None = None, most: float = MAX_NUMBER
    ) -> np.ndarray:
        values = self._take(key, list(default) if default is not None else None)
        if not isinstance(values, list):
            raise self._wrong(key, f"a list of {count} numbers")
        self._check_count(key, values, count)
        if not all(_is_number(value, most) for value in values):
            raise self._wrong(key, f"a list of {count} finite numbers of at most {most:g} in magnitude")
        return np.array(values, dtype=np.float64)

    def limits(self, key: str, count: int) -> np.ndarray:
        values = self.numbers(key, count)
        if not (values >= MIN_LIMIT).all():
            raise self._wrong(key, f"a list of numbers of at least {MIN_LIMIT:g}")
        return values

    def site(self, key: str, name: str) -> tuple[str, tuple[str, str, Frame] | None]:
        """Return the name of a site or, if the file gives body and pose, ``name`` and the site to add."""
        if isinstance(self.entries.get(key), dict):
            pose = self.table(key)
            place = Frame(pose.numbers("position", 3), pose.numbers("quaternion", 4, (1.0, 0.0, 0.0, 0.0)))
            where = (name, pose.text("body"), place)
            pose.refuse_others()
            return name, where
        return self.text(key), None

    def refuse_others(self) -> None:
        """Raise RobotFileError if there are unknown entries."""
        unknown = sorted(set(self.entries) - self._known)
        if unknown:
            known = ", ".join(sorted(self._known))
            raise RobotFileError(f"{self._called(unknown[0])} is unknown; known are {known}")

    def _take(self, key: str, default: Any = None) -> Any:
        self._known.add(key)
        value = self.entries.get(key, default)
        if value is None:
            raise RobotFileError(f"{self._called(key)} is missing")
        return value

    def _check_count(self, key: str, values: Sequence[Any], count: int | None) -> None:
        if count is not None and len(values) != count:
            raise RobotFileError(f"{self._called(key)} has {len(values)} entries, expected {count}")

    def _wrong(self, key: str, wanted: str) -> RobotFileError:
        return RobotFileError(f"{self._called(key)} = {_shortened(self.entries.get(key))} must be {wanted}")

    def _called(self, key: str) -> str:
        return f"{self.path}: {f'[{self.name}] ' if self.name else ''}{key}"


def _is_number(value: Any, most: float) -> bool:
    """Return whether an entry is a number of at most the given magnitude; NaN is none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= most


def _shortened(value: Any) -> str:
    """Return an entry for a message; Python refuses to print integers of thousands of digits."""
    try:
        text = repr(value)
    except ValueError:
        return "a very long integer"
    return text if len(text) <= 80 else f"{text[:77]}..."
