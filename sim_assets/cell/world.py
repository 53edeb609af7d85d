"""The simulated cell behind the ``Robot`` interface: motion, gripper and camera, without object poses.

The time step is 2 ms. Objects are free bodies, grasped by contact and friction only; after
settling, only the arm moves them. Only ``ground_truth`` reads their true poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from manipulation.errors import RobotError, RobotStoppedError
from manipulation.robot import ArmDescription, JointTrajectory, RobotState
from perception.types import RgbdFrame
from sim_assets.cell.arm_drive import ArmDrive
from sim_assets.cell.building import build_settled
from sim_assets.cell.config import CellConfig
from sim_assets.cell.scene import TIMESTEP, VIEWS
from sim_assets.cell.stepping import SimulationError, check_warnings
from sim_assets.rendering.camera import OffscreenRenderer, intrinsics_of
from sim_assets.rendering.depth_noise import SENSORS, add_depth_noise
from sim_assets.rendering.headless import mujoco
from sim_assets.robots.named_parts import grip_force
from sim_assets.robots.simulated_arm import WRIST_CAMERA

IMAGE_SIZE = (640, 480)
START_TOLERANCE = 0.03  # largest deviation of a trajectory's start from the arm's configuration [rad]
STOP_ERROR = 0.2  # tracking error at which the arm stops [rad]
REACHED_ERROR = 0.03  # final error above which a motion counts as blocked [rad]
FINGER_SPEED = 0.08  # [m/s], speed of one finger
_STILL = 5e-3  # [rad/s] of each joint at the end of a motion: the servos' remaining errors are below 0.5 mrad
_AT_REST = 1e-3  # [m/s] of each finger
_ARRIVED = 1e-3  # [m] between the opening of fingers at rest and their command
_QUIET_TIME, _GRIP_TIME = 0.05, 0.1  # [s] for which fingers are at rest after they have opened, or closed
WARNINGS_CHECKED_EVERY = 50  # steps

Observer = Callable[["World"], None]


class World:
    """A simulated arm over a table of objects; implements ``manipulation.robot.Robot``."""

    def __init__(self, config: CellConfig) -> None:
        """Sample the layout, build the cell and let it settle.

        Raises:
            LayoutError: the objects do not fit on the table.
        """
        self.config = config
        layout_seed, look_seed, noise_seed, error_seed = np.random.SeedSequence(config.seed).spawn(4)
        self._noise = np.random.default_rng(noise_seed)
        self._T_camera_seen = _camera_error(config.camera_error, np.random.default_rng(error_seed))
        self._robot = config.robot
        self._stop_reason = ""
        self._observer: Observer | None = None
        self._frame_period = np.inf
        self._next_frame = 0.0
        self._on_step: Callable[[], None] | None = None
        self._steps = 0
        self._model, self._data = build_settled(config, np.random.default_rng(layout_seed), look_seed)
        self._drive = ArmDrive(self._model, self._data, config.robot)
        self._renderer = OffscreenRenderer(self._model)
        self._drafts = OffscreenRenderer(self._model, draft=True)

    # The Robot protocol.

    @property
    def arm(self) -> ArmDescription:
        return self._robot.description

    @property
    def time(self) -> float:
        """Simulated time in [s]."""
        return float(self._data.time)

    def torque_limits(self) -> Float[np.ndarray, "n"]:
        """Largest torques of the arm's servos in [Nm]; infinite where the model has none."""
        return self._drive.torque_limits()

    def grip_force(self) -> float:
        """Force of each finger at full command in [N]."""
        return grip_force(self._model, self._robot)

    def state(self) -> RobotState:
        """Measured state at the present simulated time."""
        return RobotState(self.time, self.joint_positions(), self.gripper_width())

    def joint_positions(self) -> Float[np.ndarray, "n"]:
        """Measured arm joint positions in [rad]."""
        return self._drive.joint_positions()

    def gripper_width(self) -> float:
        """Measured opening between the pads in [m]."""
        return self._drive.gripper_width()

    def capture(self) -> RgbdFrame:
        """Return a registered RGB-D image of the wrist camera, with its pose from the measured joints."""
        return self._image(color=True)

    def capture_depth(self) -> RgbdFrame:
        """Return the image that ``capture`` would, black where its depth does not depend on the colour."""
        return self._image(color=self.config.depth_noise in SENSORS)

    def _image(self, color: bool) -> RgbdFrame:
        width, height = IMAGE_SIZE
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        optical = self._data.site(self.arm.camera_site)
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = optical.xmat.reshape(3, 3)
        T_world_camera[:3, 3] = optical.xpos
        intrinsics = intrinsics_of(width, height, self._robot.fovy)
        depth, _ = self._renderer.depth_and_ids(self._data, WRIST_CAMERA, width, height)
        rgb = np.zeros((height, width, 3), dtype=np.uint8)
        if color:
            rgb = self._renderer.color(self._data, WRIST_CAMERA, width, height, reflections=False)
        return RgbdFrame(
            time=self.time,
            rgb=rgb,
            depth=add_depth_noise(depth, self.config.depth_noise, intrinsics, self._noise, rgb),
            intrinsics=intrinsics,
            T_world_camera=T_world_camera @ self._T_camera_seen,
        )

    def follow(self, trajectory: JointTrajectory) -> None:
        """Execute the motion and settle.

        Raises:
            RobotError: the trajectory is malformed or does not start at the measured joint positions, or the
                arm is blocked.
            RobotStoppedError: the robot was stopped.
        """
        self._require_running()
        self._check_trajectory(trajectory)
        self._follow(trajectory)

    def follow_opening(self, trajectory: JointTrajectory, width: float) -> float:
        """Execute the motion while the pads move toward ``width`` [m]; return the width reached.

        Raises:
            RobotError, RobotStoppedError: as ``follow`` and ``move_gripper``; nothing was moved if a command
                is wrong.
        """
        self._require_running()
        self._check_trajectory(trajectory)
        self._check_width(width)
        self._follow(trajectory, self._openings(width))
        arrived = abs(self.gripper_width() - width) < _ARRIVED and self._drive.finger_speed() < _AT_REST
        return self.gripper_width() if arrived else self.move_gripper(width)

    def _follow(self, trajectory: JointTrajectory, openings: Sequence[float] = ()) -> None:
        """Execute a motion with the given openings [m] of the pads in its first time steps."""
        times = np.arange(0, trajectory.duration + TIMESTEP / 2, TIMESTEP)
        samples = np.arange(len(trajectory.positions)) * trajectory.period

        def resampled(values: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(times, samples, column) for column in values.T], axis=1)

        positions, velocities = resampled(trajectory.positions), resampled(trajectory.velocities)
        accelerations = resampled(trajectory.accelerations)
        for step, (q, qd, qdd) in enumerate(zip(positions, velocities, accelerations, strict=True)):
            self._drive.command_motion(q, qd, qdd)
            if step < len(openings):
                self._drive.command_width(openings[step])
            self._step()
            self._require_running()
            self._stop_if_blocked(q, STOP_ERROR)
        self._hold(trajectory.positions[-1])

    def move_gripper(self, width: float) -> float:
        """Open or close toward ``width`` in [m] (0 closes with full force) and return the width reached."""
        self._require_running()
        self._check_width(width)
        drive, start = self._drive, self.gripper_width()
        for wanted in self._openings(width):
            drive.command_width(wanted)
            self._step()
            self._require_running()
            if width < start and self._fingers_stalled(wanted):
                break
        drive.press() if width == 0 else drive.command_width(width)
        self._wait_for_fingers(_GRIP_TIME if width == 0 else _QUIET_TIME)
        return self.gripper_width()

    def _check_width(self, width: float) -> None:
        widest = self.arm.max_width
        if not (np.isfinite(width) and 0 <= width <= widest + 1e-6):
            raise RobotError(f"gripper width {width} m is outside 0..{widest} m")

    def _openings(self, width: float) -> Sequence[float]:
        """Return the openings [m] at each time step while the fingers move to ``width`` [m]."""
        start = self.gripper_width()
        steps = int(np.ceil(abs(width - start) / (2 * FINGER_SPEED * TIMESTEP)))
        return list(np.linspace(start, width, steps + 1)[1:])

    def stop(self, reason: str) -> None:
        """Stop the motion that is under way, at its next time step, and refuse further ones."""
        self._stop_reason = reason

    # Interface for viewers and videos.

    def wait(self, duration: float) -> None:
        """Advance the simulation by ``duration`` [s] with the last command."""
        for _ in range(round(duration / TIMESTEP)):
            self._step()

    def observe(self, observer: Observer | None, fps: float = 25.0) -> None:
        """Call ``observer(world)`` ``fps`` times per simulated second from now on; None ends it."""
        self._observer = observer
        self._frame_period = 1 / fps
        self._next_frame = self.time

    def on_step(self, callback: Callable[[], None] | None) -> None:
        """Call ``callback()`` after every time step from now on; None ends it."""
        self._on_step = callback

    def overview_image(
        self,
        width: int = 960,
        height: int = 720,
        camera: str = "overview",
        draft: bool = False,
        shadows: bool = True,
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Render the cell from one of the fixed cameras ``scene.VIEWS`` or from the wrist camera.

        Args:
            draft: whether to render at reduced quality, for videos.
            shadows: whether to render shadows.
        """
        if camera not in (*VIEWS, WRIST_CAMERA):
            raise SimulationError(f"camera '{camera}' is none of {', '.join((*VIEWS, WRIST_CAMERA))}")
        if draft:
            return self._drafts.color(self._data, camera, width, height, shadows, reflections=False)
        return self._renderer.color(self._data, camera, width, height, shadows)

    def close(self) -> None:
        """Free the GL contexts."""
        self._renderer.close()
        self._drafts.close()

    def __enter__(self) -> World:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _step(self) -> None:
        commands = self._data.ctrl
        if not math.isfinite(commands.dot(commands)):  # the fastest reduction: this runs 500 times a second
            raise RobotError("a command is not finite; no command was sent to the actuators")
        mujoco.mj_step(self._model, self._data)
        self._steps += 1
        if self._on_step is not None:
            self._on_step()
        if self._steps % WARNINGS_CHECKED_EVERY == 0:
            check_warnings(self._data)
        if self._observer is not None and self.time >= self._next_frame:
            self._next_frame += self._frame_period
            self._observer(self)

    def _check_trajectory(self, trajectory: JointTrajectory) -> None:
        shapes = {trajectory.positions.shape, trajectory.velocities.shape, trajectory.accelerations.shape}
        count = len(trajectory.positions)
        columns = len(self.arm.joint_names)
        if shapes != {(count, columns)} or count == 0:
            raise RobotError(f"a trajectory needs three arrays of {columns} columns, got {sorted(shapes)}")
        if not trajectory.period > 0:
            raise RobotError(f"trajectory period {trajectory.period} s must be positive")
        values = (trajectory.positions, trajectory.velocities, trajectory.accelerations)
        if not all(np.isfinite(value).all() for value in values):
            raise RobotError("the trajectory has NaN or infinite samples; the arm was not moved")
        away = np.abs(trajectory.positions[0] - self.joint_positions())
        if away.max() > START_TOLERANCE:
            joint = self.arm.joint_names[away.argmax()]
            raise RobotError(
                f"the trajectory starts {away.max():.3f} rad from the measured position of {joint}; "
                f"plan from joint_positions()"
            )

    def _require_running(self) -> None:
        """Hold the measured posture and raise RobotStoppedError if the robot was stopped."""
        if self._stop_reason:
            self._halt()
            raise RobotStoppedError(f"the robot was stopped: {self._stop_reason}")

    def _halt(self) -> None:
        """Hold the measured posture."""
        self._drive.command(self.joint_positions())
        self.wait(0.1)

    def _hold(self, q: np.ndarray) -> None:
        """Hold a configuration until the arm is still."""
        self._drive.command(q)
        for _ in range(250):
            self._step()
            still = np.abs(self._drive.joint_velocities()).max() < _STILL
            if still and np.abs(self.joint_positions() - q).max() < 1e-3:
                return
        self._stop_if_blocked(q, REACHED_ERROR)

    def _stop_if_blocked(self, q: np.ndarray, limit: float) -> None:
        error = np.abs(q - self.joint_positions())
        if error.max() <= limit:
            return
        worst = int(error.argmax())
        joint, reason = self.arm.joint_names[worst], self._drive.blocking_reason(worst)
        self._halt()
        raise RobotError(f"{reason}: {joint} is {error.max():.3f} rad from its command; it stopped")

    def _fingers_stalled(self, wanted: float) -> bool:
        """Return whether contact stopped the fingers: at rest, each 4 mm off the wanted width [m]."""
        return bool(0.5 * (self.gripper_width() - wanted) > 0.004 and self._drive.finger_speed() < 0.005)

    def _wait_for_fingers(self, duration: float) -> None:
        """Advance until the fingers have been still for a time [s], by 1 s at most."""
        quiet = 0
        for _ in range(500):
            self._step()
            quiet = quiet + 1 if self._drive.finger_speed() < _AT_REST else 0
            if quiet >= duration / TIMESTEP:
                return


def _camera_error(size: tuple[float, float], rng: np.random.Generator) -> Float[np.ndarray, "4 4"]:
    """Return a rigid motion of the given translation [m] and rotation [rad] in random directions."""
    directions = rng.normal(size=(2, 3))
    shift, axis = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(size[1] * axis).as_matrix()
    T[:3, 3] = size[0] * shift
    return T
