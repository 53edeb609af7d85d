"""Actions of the environments: joint targets, or changes of the tool's pose, with the gripper width.

Both kinds are translated to joint targets of ``PositionControl``. ``encode`` is the inverse of ``decode``: it
lets a policy that plans joint motions, such as the expert, act in an environment of either kind.
"""

from __future__ import annotations

from typing import Literal, Protocol, runtime_checkable

import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from manipulation.kinematics import Kinematics

Control = Literal["joint", "tcp"]
MAX_SHIFT = 0.12  # [m] of the TCP per action and axis
MAX_TURN = 0.5  # [rad] of the TCP per action and axis
LEVER = 0.5  # [m]: displacement of the TCP that counts as much as a rotation by 1 rad

Joints = Float[np.ndarray, "n"]
Action = Float[np.ndarray, "a"]


@runtime_checkable
class ActionCodec(Protocol):
    """Translation between actions and joint targets.

    Attributes:
        space: Valid actions.
        names: Name of each number of an action.
    """

    space: Box
    names: tuple[str, ...]

    def decode(self, action: Action, q: Joints) -> tuple[Joints, float]:
        """Return joint targets [rad] and gripper width [m] of an action, given the last targets ``q``."""
        ...

    def encode(self, target: Joints, width: float, q: Joints) -> Action:
        """Return the action that leads from the last targets ``q`` to ``target`` [rad] and ``width`` [m]."""
        ...

    def deviation(self, q: Joints, target: Joints) -> float:
        """Return how far the posture ``q`` is from what ``target`` commands, in radians."""
        ...


class JointActions:
    """Target positions of the joints [rad] and width between the gripper's pads [m]."""

    def __init__(self, kinematics: Kinematics) -> None:
        arm = kinematics.arm
        low, high = np.append(kinematics.lower, 0.0), np.append(kinematics.upper, arm.max_width)
        self.space = _box(low, high)
        self.names: tuple[str, ...] = (*arm.joint_names, "gripper_width")

    def decode(self, action: Action, q: Joints) -> tuple[Joints, float]:
        return np.asarray(action[:-1], dtype=np.float64), float(action[-1])

    def encode(self, target: Joints, width: float, q: Joints) -> Action:
        return _clipped(self.space, np.append(target, width))

    def deviation(self, q: Joints, target: Joints) -> float:
        return float(np.abs(q - target).max())


class TcpActions:
    """Change of the tool's pose in the world frame, and width between the gripper's pads.

    Translation (x, y, z) [m] and rotation vector [rad] are relative to the pose at the last joint targets. A
    pose that inverse kinematics does not reach leaves the arm where it is.
    """

    def __init__(self, kinematics: Kinematics) -> None:
        self._kinematics = kinematics
        reach = np.array([MAX_SHIFT] * 3 + [MAX_TURN] * 3)
        self.space = _box(np.append(-reach, 0.0), np.append(reach, kinematics.arm.max_width))
        self.names: tuple[str, ...] = ("dx", "dy", "dz", "rx", "ry", "rz", "gripper_width")

    def decode(self, action: Action, q: Joints) -> tuple[Joints, float]:
        change = np.asarray(action, dtype=np.float64)
        if not change[:6].any():
            return q, float(action[-1])
        T_goal = self._kinematics.forward(q)
        T_goal[:3, 3] += change[:3]
        T_goal[:3, :3] = Rotation.from_rotvec(change[3:6]).as_matrix() @ T_goal[:3, :3]
        result = self._kinematics.inverse(T_goal, [q], name="the commanded pose")
        return (result.q if result.converged else q), float(action[-1])

    def encode(self, target: Joints, width: float, q: Joints) -> Action:
        T_now, T_goal = self._kinematics.forward(q), self._kinematics.forward(target)
        turn = Rotation.from_matrix(T_goal[:3, :3] @ T_now[:3, :3].T).as_rotvec()
        return _clipped(self.space, np.concatenate([T_goal[:3, 3] - T_now[:3, 3], turn, [width]]))

    def deviation(self, q: Joints, target: Joints) -> float:
        change = self.encode(target, 0.0, q)
        return float(max(np.linalg.norm(change[:3]) / LEVER, np.linalg.norm(change[3:6])))


def codec_of(control: Control, kinematics: Kinematics) -> ActionCodec:
    """Return the translation for a kind of control."""
    return JointActions(kinematics) if control == "joint" else TcpActions(kinematics)


def _box(low: np.ndarray, high: np.ndarray) -> Box:
    return Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def _clipped(space: Box, action: np.ndarray) -> Action:
    return np.clip(action, space.low, space.high).astype(np.float32)
