"""The simulated cell behind the ``Robot`` interface: motion, gripper and camera, without object poses.

The time step is 2 ms. Objects are free bodies, grasped by contact and friction only; after
settling, only the arm moves them. Only ``ground_truth`` reads their true poses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from manipulation.errors import RobotError, RobotStoppedError
from manipulation.robot import ArmDescription, JointTrajectory, RobotState
from perception.types import RgbdFrame
from sim_assets.cell.arrangement import Arrangement, Group, arrange, rest_unknown
from sim_assets.cell.blocking import blocking_reason
from sim_assets.cell.layout import (
    FreePose,
    PlanarPose,
    Region,
    UnstableError,
    draw_together,
    sample_roomy_layout,
)
from sim_assets.cell.pads import pad_points
from sim_assets.cell.resting import damped
from sim_assets.cell.scene import TIMESTEP, VIEWS, BoxConfig, Pose, build_scene, set_friction
from sim_assets.cell.settling import settle_bodies
from sim_assets.cell.unknown import UnknownThing
from sim_assets.errors import SimAssetsError
from sim_assets.objects import ObjectModel
from sim_assets.rendering.camera import OffscreenRenderer, intrinsics_of
from sim_assets.rendering.depth_noise import DepthNoise, add_depth_noise
from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots import panda
from sim_assets.robots.named_parts import grip_force
from sim_assets.robots.simulated_arm import WRIST_CAMERA, SimulatedArm

IMAGE_SIZE = (640, 480)
START_TOLERANCE = 0.03  # largest deviation of a trajectory's start from the arm's configuration [rad]
STOP_ERROR = 0.2  # tracking error at which the arm stops [rad]
REACHED_ERROR = 0.03  # final error above which a motion counts as blocked [rad]
FINGER_SPEED = 0.08  # [m/s], speed of one finger
WARNINGS_CHECKED_EVERY = 50  # steps
LAYOUTS = 4  # tried for one in which nothing falls
REARRANGED = 2  # layouts after which other objects lie or are stacked
LOOSENED = 0.001  # [m] added to the gap of objects that are drawn together, from one layout to the next

Observer = Callable[["World"], None]


class SimulationError(SimAssetsError, RuntimeError):
    """The simulation diverged, or an unknown camera was requested."""


@dataclass(frozen=True)
class CellConfig:
    """Configuration of a cell.

    Attributes:
        objects: models of the objects on the table.
        box: the open box; None for a table without one.
        line: ends of the tape that marks the sorting line, in [m]; None for no tape.
        depth_noise: model of the wrist camera's depth noise.
        seed: seed of layout, colours and depth noise.
        region: region of the object centres; the default one is extended where the objects need more room.
        min_gap: minimum distance between the objects' outlines in [m].
        robot: the arm.
        drawn_together: whether objects are moved to ``min_gap`` from their nearest neighbours, 0 touching.
        arrangement: numbers of objects that lie, stand on their rim or on others.
        unknown: things of no class beside the objects.
        camera_error: calibration error of the wrist camera: translation in [m], rotation in [rad], both in a
            random direction.
        friction: range of the coefficients of sliding friction; None for fixed ones.
        scale: lengths of the default region relative to the standard cell, for arms of shorter reach.
    """

    objects: tuple[ObjectModel, ...]
    box: BoxConfig | None = field(default_factory=BoxConfig)
    line: tuple[tuple[float, float], tuple[float, float]] | None = None
    depth_noise: DepthNoise = "gaussian"
    seed: int = 0
    region: Region = field(default_factory=Region)
    min_gap: float = 0.04
    robot: SimulatedArm = field(default_factory=panda)
    drawn_together: bool = False
    arrangement: Arrangement = field(default_factory=Arrangement)
    unknown: tuple[UnknownThing, ...] = ()
    camera_error: tuple[float, float] = (0.0, 0.0)
    friction: tuple[float, float] | None = None
    scale: float = 1.0

    @property
    def is_tidy(self) -> bool:
        """Whether all objects stand upright, each for itself, so that their layout is known to be stable."""
        upright = self.arrangement == Arrangement() and not self.unknown and not self.drawn_together
        return upright and all(model.split != "user" for model in self.objects)


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
        self._build_settled(np.random.default_rng(layout_seed), look_seed)
        self._renderer = OffscreenRenderer(self._model)
        self._drafts = OffscreenRenderer(self._model, draft=True)

    def _build_settled(self, layout: np.random.Generator, look_seed: np.random.SeedSequence) -> None:
        """Build the cell and let it settle; a layout in which something falls is replaced by another."""
        config, fallen = self.config, None
        names = [f"object{i}" for i in range(len(config.objects))]
        names += [f"unknown{i}" for i in range(len(config.unknown))]
        groups, others = self._groups(layout)
        for attempt in range(LAYOUTS):
            if attempt == REARRANGED and config.arrangement != Arrangement():
                groups, others = self._groups(layout)
            places, unknown = self._sample_places(groups, others, layout, LOOSENED * attempt)
            look = np.random.default_rng(look_seed)
            things = tuple(zip(config.unknown, unknown, strict=True))
            scene = build_scene(config.objects, places, config.box, look, config.line, config.robot, things)
            if config.friction is not None:
                set_friction(scene, config.friction, look)
            self._model: MjModel = scene.compile()
            self._data = mujoco.MjData(self._model)
            self._steps = 0
            self._index()
            if config.is_tidy:
                self._settle_layout()
                return
            with damped(self._model, names):  # objects in contact may start inside each other by a hair
                self._settle_layout()
            fallen = settle_bodies(self._model, self._data, names, self.wait)
            if fallen is None:
                return
        assert fallen is not None
        reason = f"the objects do not rest stably in any of {LAYOUTS} layouts: {fallen.reason}"
        raise UnstableError(reason, fallen.name)

    def _groups(self, rng: np.random.Generator) -> tuple[list[Group], list[Group]]:
        """Return the objects and the things of no class in groups that the layout places as one."""
        config = self.config
        if config.arrangement == Arrangement():
            groups = [Group({index: None}, model.mesh) for index, model in enumerate(config.objects)]
        else:
            groups = arrange(config.objects, config.arrangement, rng)
        return groups, [rest_unknown(thing) for thing in config.unknown]

    def _sample_places(
        self, groups: list[Group], things: list[Group], rng: np.random.Generator, loosened: float
    ) -> tuple[list[Pose], list[Pose]]:
        """Return the initial poses of the objects and of the things of no class.

        Those that are drawn together keep ``loosened`` [m] more than the smallest gap.
        """
        config = self.config
        meshes = [group.mesh for group in (*groups, *things)]
        layout = sample_roomy_layout(meshes, rng, config.region, config.min_gap, config.scale)
        if config.drawn_together:
            layout = draw_together(meshes, layout, config.min_gap + loosened)
        places: dict[int, Pose] = {}
        for group, pose in zip(groups, layout[: len(groups)], strict=True):
            places |= {i: _place(pose, T) for i, T in group.Ts_group_object.items()}
        around = zip(things, layout[len(groups) :], strict=True)
        return [places[i] for i in range(len(places))], [
            _place(pose, g.Ts_group_object[0]) for g, pose in around
        ]

    def _index(self) -> None:
        model, robot = self._model, self._robot
        joints = [model.joint(name) for name in self.arm.joint_names]
        fingers = [model.joint(name) for name in self.arm.fingers.joint_names]
        self._q = np.array([joint.qposadr[0] for joint in joints])
        self._v = np.array([joint.dofadr[0] for joint in joints])
        self._u = np.array([model.actuator(name).id for name in robot.actuators])
        self._fingers = np.array([joint.qposadr[0] for joint in fingers])
        self._finger_dofs = np.array([joint.dofadr[0] for joint in fingers])
        self._pads = pad_points(model, self.arm)
        motion = self.arm.fingers
        travel = np.abs(motion.positions[-1] - motion.positions[0])
        self._finger_scale = (
            np.ptp(motion.widths) / 2 / np.maximum(travel, 1e-6)[: motion.n_driven]
        )  # to [m/s]
        self._gripper = model.actuator(robot.gripper_actuator).id
        self._stiffness = model.actuator_gainprm[self._u, 0]  # [Nm/rad]
        self._damping = model.dof_damping[self._v] - model.actuator_biasprm[self._u, 2]  # [Nm s/rad]

    def _settle_layout(self) -> None:
        data = self._data
        widest = self.arm.max_width
        data.qpos[self._q] = self.arm.q_home
        data.qpos[self._fingers] = self.arm.fingers.at(widest)
        data.ctrl[self._u] = self.arm.q_home
        data.ctrl[self._gripper] = self._robot.gripper_command(widest)
        mujoco.mj_forward(self._model, data)
        self.wait(0.5)

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
        limited = self._model.actuator_forcelimited[self._u] != 0
        return np.where(limited, np.abs(self._model.actuator_forcerange[self._u]).max(axis=1), np.inf)

    def grip_force(self) -> float:
        """Force of each finger at full command in [N]."""
        return grip_force(self._model, self._robot)

    def state(self) -> RobotState:
        """Measured state at the present simulated time."""
        return RobotState(self.time, self.joint_positions(), self.gripper_width())

    def joint_positions(self) -> Float[np.ndarray, "n"]:
        """Measured arm joint positions in [rad]."""
        return self._data.qpos[self._q].copy()

    def gripper_width(self) -> float:
        """Measured opening between the pads in [m]."""
        if self._pads is not None:
            return self._pads.opening(self._data)
        driven = self._fingers[: self.arm.fingers.n_driven]
        return self.arm.fingers.width(self._data.qpos[driven])

    def capture(self) -> RgbdFrame:
        """Return a registered RGB-D image of the wrist camera, with its pose from the measured joints."""
        width, height = IMAGE_SIZE
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        optical = self._data.site(self.arm.camera_site)
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = optical.xmat.reshape(3, 3)
        T_world_camera[:3, 3] = optical.xpos
        intrinsics = intrinsics_of(width, height, self._robot.fovy)
        depth, _ = self._renderer.depth_and_ids(self._data, WRIST_CAMERA, width, height)
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
        times = np.arange(0, trajectory.duration + TIMESTEP / 2, TIMESTEP)
        samples = np.arange(len(trajectory.positions)) * trajectory.period

        def resampled(values: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(times, samples, column) for column in values.T], axis=1)

        positions, velocities = resampled(trajectory.positions), resampled(trajectory.velocities)
        accelerations = resampled(trajectory.accelerations)
        for q, qd, qdd in zip(positions, velocities, accelerations, strict=True):
            self._command(q, qd, qdd)
            self._step()
            self._require_running()
            self._stop_if_blocked(q, STOP_ERROR)
        self._hold(trajectory.positions[-1])

    def move_gripper(self, width: float) -> float:
        """Open or close toward ``width`` in [m] (0 closes with full force) and return the width reached."""
        self._require_running()
        robot, widest = self._robot, self.arm.max_width
        if not (np.isfinite(width) and 0 <= width <= widest + 1e-6):
            raise RobotError(f"gripper width {width} m is outside 0..{widest} m")
        start = self.gripper_width()
        steps = int(np.ceil(abs(width - start) / (2 * FINGER_SPEED * TIMESTEP)))
        for wanted in np.linspace(start, width, steps + 1)[1:]:
            self._data.ctrl[self._gripper] = robot.gripper_command(wanted)
            self._step()
            self._require_running()
            if width < start and self._fingers_stalled(wanted):
                break
        self._data.ctrl[self._gripper] = robot.press if width == 0 else robot.gripper_command(width)
        self._wait_for_fingers()
        return self.gripper_width()

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
        if not np.isfinite(self._data.ctrl).all():
            raise RobotError("a command is not finite; no command was sent to the actuators")
        mujoco.mj_step(self._model, self._data)
        self._steps += 1
        if self._on_step is not None:
            self._on_step()
        if self._steps % WARNINGS_CHECKED_EVERY == 0:
            self._check_warnings()
        if self._observer is not None and self.time >= self._next_frame:
            self._next_frame += self._frame_period
            self._observer(self)

    def _check_warnings(self) -> None:
        """Raise if MuJoCo reset a diverged state, which it reports only as a warning count."""
        for kind in ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL"):
            warning = self._data.warning[int(getattr(mujoco.mjtWarning, f"mjWARN_{kind}"))]
            if warning.number:
                raise SimulationError(f"the physics diverged at {self.time:.3f} s ({kind.lower()})")

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
            self._data.ctrl[self._u] = self.joint_positions()
            self.wait(0.1)
            raise RobotStoppedError(f"the robot was stopped: {self._stop_reason}")

    def _command(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> None:
        """Send the position command with feedforward that cancels servo damping and inertia."""
        motion = np.zeros(self._model.nv)
        motion[self._v] = qdd
        torque = np.zeros(self._model.nv)
        mujoco.mj_mulM(self._model, self._data, torque, motion)
        forward = torque[self._v] + self._damping * qd
        self._data.ctrl[self._u] = q + forward / self._stiffness

    def _hold(self, q: np.ndarray) -> None:
        """Hold a configuration until the arm is still."""
        self._data.ctrl[self._u] = q
        for _ in range(250):
            self._step()
            still = np.abs(self._data.qvel[self._v]).max() < 1e-3
            if still and np.abs(self.joint_positions() - q).max() < 1e-3:
                return
        self._stop_if_blocked(q, REACHED_ERROR)

    def _stop_if_blocked(self, q: np.ndarray, limit: float) -> None:
        error = np.abs(q - self.joint_positions())
        if error.max() <= limit:
            return
        worst = int(error.argmax())
        joint, first = self.arm.joint_names[worst], self.arm.joint_names[0]
        reason = blocking_reason(self._model, self._data, joint, int(self._u[worst]), first)
        self._data.ctrl[self._u] = self.joint_positions()
        self.wait(0.1)
        raise RobotError(f"{reason}: {joint} is {error.max():.3f} rad from its command; it stopped")

    def _finger_speed(self) -> float:
        """Return the speed of the faster finger in [m/s]."""
        driven = self._finger_dofs[: self.arm.fingers.n_driven]
        return float((np.abs(self._data.qvel[driven]) * self._finger_scale).max())

    def _fingers_stalled(self, wanted: float) -> bool:
        """Return whether contact stopped the fingers: at rest, each 4 mm off the wanted width [m]."""
        return bool(0.5 * (self.gripper_width() - wanted) > 0.004 and self._finger_speed() < 0.005)

    def _wait_for_fingers(self) -> None:
        """Advance until the fingers have been still for 0.15 s, by 1 s at most."""
        quiet = 0
        for _ in range(500):
            self._step()
            quiet = quiet + 1 if self._finger_speed() < 1e-3 else 0
            if quiet >= 75:
                return


def _place(pose: PlanarPose, T_group_object: Float[np.ndarray, "4 4"] | None) -> Pose:
    """Return the initial pose of a member of a group that lies at a pose in the layout."""
    return pose if T_group_object is None else FreePose.of(pose.matrix @ T_group_object)


def _camera_error(size: tuple[float, float], rng: np.random.Generator) -> Float[np.ndarray, "4 4"]:
    """Return a rigid motion of the given translation [m] and rotation [rad] in random directions."""
    directions = rng.normal(size=(2, 3))
    shift, axis = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(size[1] * axis).as_matrix()
    T[:3, 3] = size[0] * shift
    return T
