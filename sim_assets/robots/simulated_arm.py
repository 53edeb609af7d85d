"""SimulatedArm: the planner's description of an arm plus its simulation parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from manipulation.robot import ArmDescription
from sim_assets.rendering.headless import MjSpec

WRIST_CAMERA = "wrist"  # name of the wrist camera in every scene
ARM_CONTACT = {"contype": 2, "conaffinity": 1}  # collides with all but itself: objects have both bits set
PAD_CONTACT = {  # at MuJoCo's softer default a grasped can slips by 8 mm and a mug rotates by 14 degrees
    "friction": (1.0, 0.01, 0.0005), "condim": 4, "priority": 1,
    "solref": (0.004, 1), "solimp": (0.95, 0.99, 0.001, 0.5, 2),
}  # fmt: skip


@dataclass(frozen=True)
class SimulatedArm:
    """An arm's description for planning, with its actuators and wrist camera in the simulator.

    Attributes:
        description: kinematics, collision shapes and limits, with the names used in scenes.
        add: adds the arm with visual geoms, servos and the camera ``wrist`` to a scene's specification.
        actuators: names of the joints' position servos, in joint order.
        gripper_actuator: name of the actuator that drives the fingers.
        commands: (k,) its commands at the openings ``description.fingers.widths``.
        press: its command for closing with full force.
        fovy: vertical field of view of the wrist camera in [deg].
        assumptions: what the robot file leaves open and was assumed, one sentence each.
    """

    description: ArmDescription
    add: Callable[[MjSpec], None]
    actuators: tuple[str, ...]
    gripper_actuator: str
    commands: Float[np.ndarray, "k"]
    press: float
    fovy: float
    assumptions: tuple[str, ...] = ()

    def gripper_command(self, width: float) -> float:
        """Return the gripper command for an opening of ``width`` [m] between the pads."""
        return float(self.gripper_commands(np.array([width]))[0])

    def gripper_commands(self, widths: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the gripper's commands for openings of ``widths`` [m] between the pads."""
        return np.interp(widths, self.description.fingers.widths, self.commands)
