"""Gymnasium environments of packing and sorting in the simulated cell.

``reset(seed=s)`` builds the cell of ``nodeslam pack --seed s`` or ``nodeslam sort --seed s``. Actions and
observations have a fixed rate; the physics advances by one control period per step.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import msgspec
import numpy as np
from gymnasium import spaces
from jaxtyping import Float, UInt8

from app.environments.actions import Control, codec_of
from app.environments.privileged import COLUMNS, PrivilegedState
from app.environments.registration import RATE
from app.environments.rewards import RewardKind, TaskReward
from app.errors import UsageError
from app.options import CellOptions, Task
from app.task.cell import build_world, check_options, parse_objects, robot_of
from manipulation.kinematics import Kinematics
from sim_assets.cell.position_control import PositionControl
from sim_assets.cell.stepping import SimulationError
from sim_assets.cell.world import World

CAMERAS = {"wrist": "wrist", "scene": "overview"}  # name in observations: name in the cell
TABLE_REACH = 3.0  # [m]: bound of the objects' coordinates
MAX_JOINT_SPEED = 10.0  # [rad/s], bound of the observed joint velocities
MAX_SEED = 2**31 - 1
MIN_RATE, MAX_RATE = 1.0, 200.0  # [Hz] of actions
MIN_SIDE, MAX_SIDE = 16, 4096  # [px] of images

Observation = dict[str, np.ndarray]


@dataclass
class Cell:
    """One episode's cell with its control, reward and sensors."""

    world: World
    control: PositionControl
    reward: TaskReward
    objects: PrivilegedState


class CellEnv(gymnasium.Env[Any, np.ndarray]):
    """The cell as an environment; see ``PackEnv`` and ``SortEnv``.

    Observations are a dictionary:

    - ``state``: positions [rad] and velocities [rad/s] of the joints, and the width between the pads [m].
    - ``objects``, if ``privileged``: true pose (position, quaternion wxyz), one-hot class, height and radius
      of each object, in metres.
    - ``wrist`` and ``scene``, if ``images``: RGB images of the wrist camera and of a fixed camera.

    ``info`` has ``placed`` (whether each object is in place), ``success``, and ``time`` [s]. An episode
    terminates when all objects are in place, and is truncated when the physics diverges or the time is up.

    Attributes:
        task: Packing or sorting.
        cell_options, render_mode, rate: Those of the constructor.
        robot: The arm.
        kinematics: Its kinematics.
        codec: Translation of actions.
        n_objects: Number of objects in each episode.
        entries: Spaces of the entries of observations.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": round(RATE)}  # pyright: ignore[reportIncompatibleVariableOverride]
    task: Task

    def __init__(
        self,
        control: Control = "joint",
        reward: RewardKind = "sparse",
        images: bool = False,
        privileged: bool = False,
        image_size: tuple[int, int] = (224, 224),
        rate: float = RATE,
        render_mode: str | None = None,
        **cell: Any,
    ) -> None:
        """Prepare the environment; the cell is built by ``reset``.

        Args:
            control: Kind of actions: ``joint`` or ``tcp``; see ``app.environments.actions``.
            reward: ``sparse`` or ``shaped``; see ``app.environments.rewards``.
            images: Whether observations have images.
            privileged: Whether observations have the true states of the objects.
            image_size: Width and height of the images in pixels.
            rate: Actions per simulated second.
            render_mode: ``rgb_array`` or None.
            cell: Options of the cell by name, such as ``objects="mug=2,can=1"``; see ``CellOptions``.

        Raises:
            UsageError: An option is invalid.
        """
        if control not in ("joint", "tcp") or reward not in ("sparse", "shaped"):
            raise UsageError(f"control={control!r}, reward={reward!r}: give joint or tcp, sparse or shaped")
        if render_mode not in (None, "rgb_array"):
            raise UsageError(f"render_mode={render_mode!r}: give 'rgb_array' or None")
        if not MIN_RATE <= rate <= MAX_RATE:
            raise UsageError(f"rate={rate:g}: give {MIN_RATE:g} to {MAX_RATE:g} actions per second")
        if len(image_size) != 2 or not all(
            isinstance(side, int) and MIN_SIDE <= side <= MAX_SIDE for side in image_size
        ):
            raise UsageError(
                f"image_size={image_size!r}: give width and height of {MIN_SIDE} to {MAX_SIDE} px"
            )
        self.cell_options = _cell_options(cell)
        check_options(self.cell_options)
        self.render_mode, self.rate = render_mode, rate
        self.robot = robot_of(self.cell_options)
        self.kinematics = Kinematics(self.robot.description)
        self.codec = codec_of(control, self.kinematics)
        self.action_space = self.codec.space
        self._images, self._privileged, self._image_size = images, privileged, image_size
        self._reward_kind: RewardKind = reward
        self.n_objects = len(parse_objects(self.cell_options.objects, np.random.default_rng(0)))
        self.entries = self._observation_spaces(self.n_objects)
        self.observation_space = spaces.Dict({**self.entries})
        self._cell: Cell | None = None

    @property
    def cell(self) -> Cell:
        """The cell of the present episode.

        Raises:
            UsageError: The environment has not been reset.
        """
        if self._cell is None:
            raise UsageError("the environment has no cell: call reset() first")
        return self._cell

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Build the cell of ``seed``; without one, of a number drawn from the environment's generator."""
        super().reset(seed=seed)
        self.close()
        number = seed if seed is not None else int(self.np_random.integers(MAX_SEED))
        world = build_world(replace(self.cell_options, seed=number), self.task)
        control = PositionControl(world, self.rate)
        objects = PrivilegedState(world)
        reward = TaskReward(world, objects, self.task, self._reward_kind)
        reward.reset(control.tcp_position())
        self._cell = Cell(world, control, reward, objects)
        placed = np.zeros(len(objects.categories), dtype=bool)
        return self._observe(), {"placed": placed, "success": False, "time": world.time}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Execute an action for one control period; it is clipped to the action space.

        Raises:
            UsageError: The action is of another shape or not finite, or there was no ``reset``.
        """
        cell, shape = self.cell, self.codec.space.shape
        if np.shape(action) != shape or not np.isfinite(action).all():
            raise UsageError(f"the action must hold {shape} finite numbers")
        q, width = self.codec.decode(
            np.clip(action, self.codec.space.low, self.codec.space.high), cell.control.q
        )
        diverged = False
        try:
            cell.control.advance(q, width)
        except SimulationError:
            diverged = True
        judgement = cell.reward.step(cell.control.tcp_position())
        info = {"placed": judgement.placed.copy(), "success": judgement.success, "time": cell.world.time}
        return self._observe(), judgement.reward, judgement.success, diverged, info

    def render(self) -> UInt8[np.ndarray, "h w 3"] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return an image of the whole cell; None without ``render_mode="rgb_array"``."""
        return self.cell.world.overview_image(640, 480, draft=True) if self.render_mode else None

    def images(self) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
        """Return the images of all cameras, whether or not observations have them."""
        size, world = self._image_size, self.cell.world
        return {
            name: world.overview_image(*size, camera=camera, draft=True, shadows=False)
            for name, camera in CAMERAS.items()
        }

    @property
    def categories(self) -> tuple[str, ...]:
        """Class of each object of the present episode."""
        return self.cell.objects.categories

    def object_states(self) -> Float[np.ndarray, "n 13"]:
        """Return the true states of the objects, as in privileged observations."""
        return self.cell.objects.table()

    def close(self) -> None:
        """Free the cell."""
        if self._cell is not None:
            self._cell.world.close()
            self._cell = None

    def _observation_spaces(self, n_objects: int) -> dict[str, spaces.Box]:
        kinematics, arm = self.kinematics, self.robot.description
        speed = np.full(len(arm.joint_names), MAX_JOINT_SPEED)
        low = np.concatenate([kinematics.lower - 0.1, -speed, [0.0]]).astype(np.float32)
        high = np.concatenate([kinematics.upper + 0.1, speed, [arm.max_width]]).astype(np.float32)
        entries: dict[str, spaces.Box] = {"state": spaces.Box(low, high, dtype=np.float32)}
        if self._privileged:
            shape = (n_objects, len(COLUMNS))
            entries["objects"] = spaces.Box(-TABLE_REACH, TABLE_REACH, shape, dtype=np.float32)
        if self._images:
            shape = (self._image_size[1], self._image_size[0], 3)
            entries |= {name: spaces.Box(0, 255, shape, dtype=np.uint8) for name in CAMERAS}
        return entries

    def _observe(self) -> Observation:
        cell, space = self.cell, self.entries["state"]
        q, state = cell.world.joint_positions(), np.empty(space.low.shape, dtype=np.float32)
        state[: len(q)], state[len(q) : -1] = q, cell.control.joint_velocities()
        state[-1] = cell.world.gripper_width()
        observation: Observation = {"state": np.minimum(np.maximum(state, space.low), space.high)}
        if self._privileged:
            observation["objects"] = self.object_states().clip(-TABLE_REACH, TABLE_REACH)
        if self._images:
            observation |= self.images()
        return observation


def _cell_options(values: dict[str, Any]) -> CellOptions:
    """Return options of the cell, whose names and types are checked; raise UsageError."""
    try:
        unknown = sorted(values.keys() - {field.name for field in fields(CellOptions)})
        if unknown:
            raise TypeError(f"there is no option {unknown[0]}")
        return msgspec.convert(values, CellOptions, dec_hook=_path)
    except (TypeError, msgspec.ValidationError) as error:
        raise UsageError(f"{error}: give options of the cell such as objects='6'") from None


def _path(kind: type, value: Any) -> Path:
    if not isinstance(value, str | Path):
        raise TypeError(f"{value!r} is no path")
    return Path(value)


class PackEnv(CellEnv):
    """Pack all objects on the table into the box: ``nodeslam/Pack-v0``."""

    task = "pack"


class SortEnv(CellEnv):
    """Sort all objects on the table by size along a line: ``nodeslam/Sort-v0``."""

    task = "sort"
