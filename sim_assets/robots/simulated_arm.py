"""What a cell has to know of the arm that works in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from manipulation.robot import ArmDescription
from sim_assets.rendering.headless import MjSpec

WRIST_CAMERA = "wrist"  # the camera's name in every scene, whatever the arm
ARM_CONTACT = {"contype": 2, "conaffinity": 1}  # meets everything but itself: objects have both bits set
PAD_CONTACT = {  # with MuJoCo's soft default a gripped can slips 8 mm and a mug turns by 14 degrees
    "friction": (1.0, 0.01, 0.0005), "condim": 4, "priority": 1,
    "solref": (0.004, 1), "solimp": (0.95, 0.99, 0.001, 0.5, 2),
}  # fmt: skip


@dataclass(frozen=True)
class SimulatedArm:
    """An arm as planning knows it, and what the simulator needs besides.

    Attributes:
        description: the arm alone, for planning; its names are those of the scene.
        add: adds the arm, its looks, its servos and the camera ``wrist`` to the specification of a scene.
        actuators: position servos of the arm joints, in their order.
        gripper_actuator: drives both fingers.
        open, closed: its command for the full width, and for pads that meet.
        press: its command for closing with full force.
        fovy: vertical field of view of the wrist camera in [deg].
    """

    description: ArmDescription
    add: Callable[[MjSpec], None]
    actuators: tuple[str, ...]
    gripper_actuator: str
    open: float
    closed: float
    press: float
    fovy: float

    def gripper_command(self, opening: float) -> float:
        """The actuator's command for each finger to open by ``opening`` in [m]."""
        return self.closed + opening * ((self.open - self.closed) / (self.description.max_width / 2))
