"""Position control of the cell's arm and gripper at a fixed rate, the interface of policies.

A policy commands joint positions and a gripper width a few times per second. In between, the joint commands
follow cubic polynomials with continuous velocity, since steps of velocity would shake an object out of the
fingers, with feedforward that cancels the servos' damping and the inertia. The fingers move at FINGER_SPEED.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from sim_assets.cell.scene import TIMESTEP
from sim_assets.cell.stepping import check_warnings
from sim_assets.cell.world import FINGER_SPEED, World
from sim_assets.errors import SimAssetsError
from sim_assets.rendering.headless import mujoco


class PositionControl:
    """Executes position commands in a cell, one control period at a time.

    Attributes:
        period: control period in [s].
        lower, upper: (n,) joint limits in [rad].
        q: (n,) joint positions in [rad] commanded last.
    """

    def __init__(self, world: World, rate: float) -> None:
        """Take over the arm at its present posture.

        Args:
            world: the cell.
            rate: commands per second; the period is rounded to a multiple of the physics time step.

        Raises:
            SimAssetsError: the rate is not positive, or above that of the physics.
        """
        if not 0 < rate <= 1 / TIMESTEP:
            raise SimAssetsError(
                f"a control rate of {rate:g} Hz must be more than 0 and at most {1 / TIMESTEP:g}"
            )
        self._world = world
        self._n_steps = round(1 / (rate * TIMESTEP))
        self.period = self._n_steps * TIMESTEP
        ranges = np.array([world._model.joint(name).range for name in world.arm.joint_names])
        self.lower, self.upper = ranges[:, 0], ranges[:, 1]
        self.q = np.clip(world.joint_positions(), self.lower, self.upper)
        self._opening = world.gripper_width() / 2  # of each finger, commanded
        self._tcp = world._model.site(world.arm.tcp_site).id
        self._step = np.zeros_like(self.q)  # of the last period [rad]
        self._speed = np.zeros_like(self.q)  # at its end, in [rad] per period
        self._basis = _hermite(np.arange(1, self._n_steps + 1) / self._n_steps)
        self._count = np.arange(1, self._n_steps + 1)
        self._reach = np.asarray(world.arm.velocity_limit) * self.period  # of the joints in a period [rad]
        self._ends = np.empty((3, len(self.q)))  # scratch, as are the following
        self._torque_of_ends = np.empty_like(self._ends)
        self._motion, self._torque = np.zeros(world._model.nv), np.empty(world._model.nv)

    def reachable(self, q: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the joint positions nearest to ``q`` within the limits of position and velocity."""
        near = np.minimum(np.maximum(q, self.q - self._reach), self.q + self._reach)
        return np.minimum(np.maximum(near, self.lower), self.upper)

    def tcp_position(self) -> Float[np.ndarray, "3"]:
        """Return the position of the tool's centre point in [m] at the beginning of the last physics step."""
        return self._world._data.site_xpos[self._tcp].copy()

    def joint_velocities(self) -> Float[np.ndarray, "n"]:
        """Return the measured velocities of the joints in [rad/s]."""
        return self._world._drive.joint_velocities()

    def advance(self, q: Float[np.ndarray, "n"], width: float) -> None:
        """Move the arm toward ``q`` [rad] and the fingers toward ``width`` [m] for one control period.

        The commands are limited to the joints' positions and velocities. A width of 0 closes with full force.

        Raises:
            SimAssetsError: a command is not finite.
            SimulationError: the physics diverged.
        """
        if not (np.isfinite(q).all() and np.isfinite(width)):
            raise SimAssetsError("a command is not finite; the arm was not moved")
        world, q = self._world, self.reachable(q)
        model, data, ctrl, step_physics = world._model, world._data, world._data.ctrl, mujoco.mj_step
        rows = np.empty((self._n_steps, model.nu))
        rows[:] = ctrl
        rows[:, world._drive.servos] = self._commands(q)
        rows[:, world._drive.gripper] = self._openings(min(max(float(width), 0.0), world.arm.max_width))
        for row in rows:
            ctrl[:] = row
            step_physics(model, data)
        check_warnings(data)

    def hold(self) -> None:
        """Repeat the last command for one control period, in a single call of MuJoCo."""
        mujoco.mj_step(self._world._model, self._world._data, self._n_steps)

    def _commands(self, q: Float[np.ndarray, "n"]) -> Float[np.ndarray, "steps n"]:
        """Return the servos' commands [rad] on the way to ``q``, and remember where it ends."""
        drive, step = self._world._drive, q - self.q
        # The speed at the end continues the trend of the last two steps; it never points backwards.
        speed = 1.5 * step - 0.5 * self._step
        speed = np.where(speed * step > 0, speed, 0.0)
        ends = self._ends
        ends[0], ends[1], ends[2] = step, self._speed, speed
        position, velocity, _ = self._basis @ ends
        torque = self._basis[2] @ self._times_inertia(ends) / self.period**2
        torque += velocity / self.period * drive.damping
        commands = self.q + position + torque / drive.stiffness
        self.q, self._step, self._speed = q, step, speed
        return commands

    def _times_inertia(self, rows: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k n"]:
        """Return each row multiplied by the arm's inertia matrix at the present posture."""
        model, data, dofs = self._world._model, self._world._data, self._world._drive.dofs
        motion, torque = self._motion, self._torque  # zero but at the arm's joints
        for row, result in zip(rows, self._torque_of_ends, strict=True):
            motion[dofs] = row
            mujoco.mj_mulM(model, data, torque, motion)
            result[:] = torque[dofs]
        return self._torque_of_ends

    def _openings(self, width: float) -> Float[np.ndarray, "steps"]:
        """Return the gripper's command at each physics step of a period."""
        robot, target = self._world._robot, width / 2
        measured = self._world.gripper_width() / 2
        if target > measured:  # fingers pressed against an object open at once
            self._opening = max(self._opening, measured)
        reach = FINGER_SPEED * self.period
        start, goal = self._opening, min(max(target, self._opening - reach), self._opening + reach)
        self._opening = goal
        if width == 0 and 2 * goal <= self._world.arm.gripper.min_width:
            return np.full(self._n_steps, robot.press)
        path = start + self._count * ((goal - start) / self._n_steps)
        path[-1] = goal
        return robot.gripper_commands(2 * path)


def _hermite(s: Float[np.ndarray, "k"]) -> Float[np.ndarray, "3 k 3"]:
    """Return the cubic Hermite basis of the step and the speeds at both ends, at fractions of a period.

    Returns:
        Factors of (step, first speed, last speed) in position, velocity and acceleration at each fraction.
    """
    return np.array(
        [
            [3 * s**2 - 2 * s**3, s - 2 * s**2 + s**3, s**3 - s**2],
            [6 * s - 6 * s**2, 1 - 4 * s + 3 * s**2, 3 * s**2 - 2 * s],
            [6 - 12 * s, 6 * s - 4, 6 * s - 2],
        ]
    ).transpose(0, 2, 1)
