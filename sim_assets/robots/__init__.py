"""Simulated arms: shipped arms by name, users' arms by robot file."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from sim_assets.rendering.headless import MjSpec
from sim_assets.robots.panda_arm import (
    ARM_JOINTS,
    FULL_CLOSE,
    GRIPPER_ACTUATOR,
    MAX_WIDTH,
    WRIST_FOVY,
    add_arm,
    arm_description,
)
from sim_assets.robots.panda_visuals import dress_arm
from sim_assets.robots.robot_file import read_robot
from sim_assets.robots.simulated_arm import SimulatedArm

PANDA = "panda"
ROBOT_FILE = "robot.toml"
_FOLDER = Path(__file__).parent
SHIPPED = (PANDA, *sorted(path.parent.name for path in _FOLDER.glob(f"*/{ROBOT_FILE}")))


def load_robot(spec: str) -> SimulatedArm:
    """Load a shipped arm by name, or the arm of a robot file by path.

    Raises:
        RobotFileError: the arm is unknown, or its file is unusable.
    """
    if spec == PANDA:
        return panda()
    return read_robot(_FOLDER / spec / ROBOT_FILE if spec in SHIPPED else Path(spec), SHIPPED)


@functools.cache
def panda() -> SimulatedArm:
    """Return the arm of ``sim_assets.robots.panda_arm``."""
    return SimulatedArm(
        description=arm_description(),
        add=_add_dressed_panda,
        actuators=ARM_JOINTS,
        gripper_actuator=GRIPPER_ACTUATOR,
        commands=np.array([0.0, MAX_WIDTH / 2]),
        press=FULL_CLOSE,
        fovy=WRIST_FOVY,
    )


def _add_dressed_panda(spec: MjSpec) -> None:
    add_arm(spec)
    dress_arm(spec)
