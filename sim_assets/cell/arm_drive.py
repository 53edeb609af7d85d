"""The joints and servos of the arm and its hand in a compiled cell: what is measured and commanded."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from sim_assets.cell.blocking import blocking_reason
from sim_assets.cell.pads import pad_points
from sim_assets.rendering.headless import MjData, MjModel, mujoco
from sim_assets.robots.simulated_arm import SimulatedArm


class ArmDrive:
    """Reads joints from, and writes servo commands to, the state of a cell.

    Attributes:
        dofs: (n,) indices of the arm's joints in the velocities of the model.
        servos: (n,) indices of their actuators.
        gripper: index of the actuator of the fingers.
        stiffness, damping: (n,) of the servos, in [Nm/rad] and [Nm s/rad].
    """

    def __init__(self, model: MjModel, data: MjData, robot: SimulatedArm) -> None:
        self._model, self._data, self._robot = model, data, robot
        self._motion = robot.description.fingers
        joints = [model.joint(name) for name in robot.description.joint_names]
        fingers = [model.joint(name) for name in self._motion.joint_names]
        driven = fingers[: self._motion.n_driven]
        self._q = np.array([joint.qposadr[0] for joint in joints])
        self.dofs = np.array([joint.dofadr[0] for joint in joints])
        self.servos = np.array([model.actuator(name).id for name in robot.actuators])
        self.gripper: int = model.actuator(robot.gripper_actuator).id
        self.stiffness = model.actuator_gainprm[self.servos, 0]
        self.damping = model.dof_damping[self.dofs] - model.actuator_biasprm[self.servos, 2]
        self._fingers = np.array([joint.qposadr[0] for joint in fingers])
        self._finger_dofs = np.array([joint.dofadr[0] for joint in driven])
        travel = np.abs(self._motion.positions[-1] - self._motion.positions[0])[: self._motion.n_driven]
        self._finger_scale = np.ptp(self._motion.widths) / 2 / np.maximum(travel, 1e-6)  # to [m/s]
        self._pads = pad_points(model, robot.description)
        self._motion_of_all, self._torque_of_all = np.zeros(model.nv), np.zeros(model.nv)  # scratch

    def reset(self) -> None:
        """Set state and commands to the home posture with the hand open."""
        arm, data = self._robot.description, self._data
        data.qpos[self._q] = arm.q_home
        data.qpos[self._fingers] = arm.fingers.at(arm.max_width)
        self.command(np.asarray(arm.q_home))
        self.command_width(arm.max_width)
        mujoco.mj_forward(self._model, data)

    def joint_positions(self) -> Float[np.ndarray, "n"]:
        """Return the measured joint positions of the arm in [rad]."""
        return self._data.qpos[self._q]

    def joint_velocities(self) -> Float[np.ndarray, "n"]:
        """Return the measured joint velocities of the arm in [rad/s]."""
        return self._data.qvel[self.dofs]

    def torque_limits(self) -> Float[np.ndarray, "n"]:
        """Return the largest torques of the arm's servos in [Nm]; infinite where the model has none."""
        limited = self._model.actuator_forcelimited[self.servos] != 0
        largest = np.abs(self._model.actuator_forcerange[self.servos]).max(axis=1)
        return np.where(limited, largest, np.inf)

    def command(self, q: Float[np.ndarray, "n"]) -> None:
        """Command joint positions [rad]."""
        self._data.ctrl[self.servos] = q

    def command_motion(
        self, q: Float[np.ndarray, "n"], qd: Float[np.ndarray, "n"], qdd: Float[np.ndarray, "n"]
    ) -> None:
        """Command joint positions with feedforward that cancels the servos' damping and the inertia.

        Args:
            q, qd, qdd: wanted positions [rad], velocities [rad/s] and accelerations [rad/s^2].
        """
        motion, torque = self._motion_of_all, self._torque_of_all  # zero but at the arm's joints
        motion[self.dofs] = qdd
        mujoco.mj_mulM(self._model, self._data, torque, motion)
        forward = torque[self.dofs] + self.damping * qd
        self._data.ctrl[self.servos] = q + forward / self.stiffness

    def blocking_reason(self, joint: int) -> str:
        """Return why a joint, by its place in the arm, is far from its command."""
        names = self._robot.description.joint_names
        return blocking_reason(self._model, self._data, names[joint], int(self.servos[joint]), names[0])

    def gripper_width(self) -> float:
        """Return the measured opening between the pads in [m]."""
        if self._pads is not None:
            return self._pads.opening(self._data)
        return self._motion.width(self._data.qpos[self._fingers[: self._motion.n_driven]])

    def finger_speed(self) -> float:
        """Return the speed of the faster finger in [m/s]."""
        return float((np.abs(self._data.qvel[self._finger_dofs]) * self._finger_scale).max())

    def command_width(self, width: float) -> None:
        """Command an opening [m] between the pads."""
        self._data.ctrl[self.gripper] = self._robot.gripper_command(width)

    def press(self) -> None:
        """Close with full force."""
        self._data.ctrl[self.gripper] = self._robot.press
