"""Faults put into a running cell by hand: things that happen on real tables and that no plan contains.

The robot under test is wrapped: one fault per episode, at a moment and on an object drawn from a seed. Only
the simulated bodies are touched. The pipeline has no access to what was done.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from manipulation.robot import ArmDescription, JointTrajectory, RobotState
from perception.types import RgbdFrame
from sim_assets.cell.free_bodies import ROLLING_CONTACT
from sim_assets.cell.world import World
from sim_assets.rendering.headless import mujoco
from sim_assets.robots.finger_motion import is_below

FaultKind = Literal["knock-over", "move", "take-away", "slip", "missed-grasp"]
KINDS: tuple[FaultKind, ...] = get_args(FaultKind)

MOVE_DISTANCE = 0.05  # [m]
TIP = np.deg2rad(60)  # initial tilt of what is knocked over: it falls from there by itself
TIPPED_CLASSES = ("bottle", "can", "mug")  # a bowl that is pushed slides
SLIP_HEIGHTS = (0.01, 0.08)  # [m] over its place at which an object slips from the hand
UNTOUCHED = 0.02  # [m] from its first place within which an object counts as not yet handled
HAND_CLEARANCE = 0.12  # [m] from the TCP of an object that is touched by hand, if there is a choice
NEIGHBOUR_CLEARANCE = 0.02  # [m] between the circles around an object that is moved and around another one
TABLE_ROOM = (0.22, 0.74)  # [m] distances from the base within which objects are left
CHECK_EVERY = 5  # steps between two checks whether the fingers are clear of an object
_AWAY = np.array([0.0, 2.5, 0.3])  # [m], where objects that are taken away are put: on the floor behind


@dataclass(frozen=True)
class FaultRecord:
    """A fault that occurred.

    Attributes:
        kind: Kind of the fault.
        object: Number of the object.
        time: Simulated time in [s].
    """

    kind: FaultKind
    object: int
    time: float


class FaultyRobot:
    """A simulated robot on whose table one fault occurs; implements ``manipulation.robot.Robot``.

    Objects are knocked over, moved or taken away before the first grasp or during the transfer of one of the
    objects; a grasp is missed or slips at one of the closings of the gripper. Which one is drawn.

    Args:
        world: The cell.
        kind: Kind of the fault.
        seed: Seed of moment, object and direction.

    Attributes:
        record: The fault; None until it has occurred.
    """

    def __init__(self, world: World, kind: FaultKind, seed: int) -> None:
        self._world = world
        self._kind: FaultKind = kind
        self._rng = np.random.default_rng(np.random.SeedSequence([seed, KINDS.index(kind)]))
        count = len(world.config.objects)
        by_hand = kind in ("knock-over", "move", "take-away")
        self._closing = int(self._rng.integers(0, count) if by_hand else self._rng.integers(1, count + 1))
        self._height = float(self._rng.uniform(*SLIP_HEIGHTS))
        self._bodies = _Bodies(world)
        self._start = [self._bodies.position(i) for i in range(count)]
        self._n_closings = self._n_motions = 0
        self.record: FaultRecord | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return kind, object and time; object and time are None where the fault did not occur."""
        if self.record is not None:
            return asdict(self.record)
        return {"kind": self._kind, "object": None, "time": None}

    @property
    def arm(self) -> ArmDescription:
        return self._world.arm

    def state(self) -> RobotState:
        return self._world.state()

    def stop(self, reason: str) -> None:
        self._world.stop(reason)

    def joint_positions(self) -> Float[np.ndarray, "n"]:
        return self._world.joint_positions()

    def gripper_width(self) -> float:
        return self._world.gripper_width()

    def capture(self) -> RgbdFrame:
        return self._world.capture()

    def capture_depth(self) -> RgbdFrame:
        return self._world.capture_depth()

    def follow(self, trajectory: JointTrajectory) -> None:
        self._n_motions += 1
        if self._n_motions == 2 and 0 < self._n_closings == self._closing:  # the first one is the lift
            self._touch_by_hand()
        self._world.follow(trajectory)

    def move_gripper(self, width: float) -> float:
        if self._n_closings == 0 == self._closing:
            self._touch_by_hand()
        if width == 0 and self.record is None:
            self._n_closings, self._n_motions = self._n_closings + 1, 0
            if self._n_closings == self._closing and self._kind == "missed-grasp":
                self._let_fingers_pass(self._bodies.nearest_to_tcp())
            elif self._n_closings == self._closing and self._kind == "slip":
                self._slip_when_lifted(self._bodies.nearest_to_tcp())
        return self._world.move_gripper(width)

    def _touch_by_hand(self) -> None:
        """Knock over, move or take away an object that has not been handled, if there is one."""
        if self.record is not None or self._kind in ("slip", "missed-grasp"):
            return
        bodies = self._bodies
        places = [bodies.position(i) for i in range(len(self._start))]
        there = [i for i, T in enumerate(places) if np.linalg.norm(T - self._start[i]) < UNTOUCHED]
        if self._kind == "knock-over":
            there = [i for i in there if bodies.category(i) in TIPPED_CLASSES] or there
        tcp = bodies.tcp()
        far = [i for i in there if np.linalg.norm((places[i] - tcp)[:2]) > HAND_CLEARANCE] or there
        if not far:
            return
        number = int(self._rng.choice(far))
        if self._kind == "take-away":
            bodies.put(number, _AWAY, Rotation.identity())
        elif self._kind == "move":
            direction = self._free_direction(number, MOVE_DISTANCE, bodies.radius(number))
            bodies.put(number, places[number] + MOVE_DISTANCE * direction, Rotation.identity())
        else:
            self._tip(number, places[number])
        self._note(number)

    def _tip(self, number: int, place: Float[np.ndarray, "3"]) -> None:
        """Tilt an object about the edge of its base, away from its neighbours."""
        bodies = self._bodies
        bodies.let_rest(number)
        radius, height = bodies.radius(number), bodies.height(number)
        direction = self._free_direction(number, radius + height / 2, height / 2)
        turn = Rotation.from_rotvec(TIP * np.cross((0, 0, 1), direction))
        edge = place + bodies.base_radius(number) * direction
        bodies.put(number, edge + turn.apply(place - edge) + (0, 0, 0.002), turn)

    def _free_direction(self, number: int, distance: float, radius: float) -> Float[np.ndarray, "3"]:
        """Return a random direction in which a circle of a radius [m] is free after a distance [m].

        Where no direction is free, the one with the largest clearance.
        """
        bodies, place = self._bodies, self._bodies.position(number)
        others = [i for i in range(len(self._start)) if i != number]
        best, most = np.array([1.0, 0.0, 0.0]), -np.inf
        for angle in 2 * np.pi * self._rng.permutation(24) / 24:
            direction = np.array([np.cos(angle), np.sin(angle), 0.0])
            goal = place + distance * direction
            gaps = [
                float(np.linalg.norm((bodies.position(i) - goal)[:2])) - bodies.radius(i) - radius
                for i in others
            ]
            reach = float(np.linalg.norm(goal[:2])) + radius
            room = min(TABLE_ROOM[1] - reach, reach - 2 * radius - TABLE_ROOM[0])
            clearance = min([*(gap - NEIGHBOUR_CLEARANCE for gap in gaps), room, -goal[1] - radius])
            if clearance > 0:
                return direction
            if clearance > most:
                best, most = direction, clearance
        return best

    def _slip_when_lifted(self, number: int) -> None:
        start = self._bodies.position(number)[2]

        def check() -> None:
            if self._bodies.position(number)[2] - start > self._height:
                self._let_fingers_pass(number)

        self._world.on_step(check)

    def _let_fingers_pass(self, number: int) -> None:
        """Switch the contacts of the fingers off until they are clear of the object."""
        bodies, steps = self._bodies, 0
        bodies.let_rest(number)
        bodies.set_finger_contacts(False)
        self._note(number)

        def check() -> None:
            nonlocal steps
            steps += 1
            if steps % CHECK_EVERY == 0 and bodies.fingers_clear():
                bodies.set_finger_contacts(True)
                self._world.on_step(None)

        self._world.on_step(check)

    def _note(self, number: int) -> None:
        self.record = FaultRecord(self._kind, number, self._world.time)


class _Bodies:
    """The simulated objects and fingers of a cell, for manipulation by hand."""

    def __init__(self, world: World) -> None:
        self._world, self._model, self._data = world, world._model, world._data
        model = self._model
        hand = [int(model.joint(name).bodyid[0]) for name in world.arm.fingers.joint_names]
        of_fingers = [
            geom
            for geom in range(model.ngeom)
            if model.geom_contype[geom] | model.geom_conaffinity[geom]
            and any(is_below(model, int(model.geom_bodyid[geom]), finger) for finger in hand)
        ]
        self._fingers = np.array(of_fingers, dtype=int)
        self._contype, self._conaffinity = (
            model.geom_contype[self._fingers].copy(),
            model.geom_conaffinity[self._fingers].copy(),
        )

    def category(self, number: int) -> str:
        return self._world.config.objects[number].category

    def position(self, number: int) -> Float[np.ndarray, "3"]:
        """Position of the centre of its base in [m]."""
        return self._data.joint(f"object{number}").qpos[:3].copy()

    def radius(self, number: int) -> float:
        """Radius [m] of the circle about its axis that holds all of it."""
        vertices = self._world.config.objects[number].mesh.vertices
        return float(np.linalg.norm(vertices[:, :2], axis=1).max())

    def base_radius(self, number: int) -> float:
        """Distance [m] of its axis from the edge of its base."""
        vertices = self._world.config.objects[number].mesh.vertices
        low = vertices[vertices[:, 2] < vertices[:, 2].min() + 0.004]
        return float(np.linalg.norm(low[:, :2], axis=1).max())

    def height(self, number: int) -> float:
        return float(np.ptp(self._world.config.objects[number].mesh.vertices[:, 2]))

    def tcp(self) -> Float[np.ndarray, "3"]:
        return self._data.site(self._world.arm.tcp_site).xpos.copy()

    def nearest_to_tcp(self) -> int:
        """Return the object whose geoms are nearest to the TCP."""
        count = len(self._world.config.objects)
        distance = [
            min(float(np.linalg.norm(self._data.geom_xpos[g] - self.tcp())) for g in self._geoms(i))
            for i in range(count)
        ]
        return int(np.argmin(distance))

    def put(self, number: int, position: Float[np.ndarray, "3"], turn: Rotation) -> None:
        """Set a position [m] and turn an object; it is then at rest."""
        joint = self._data.joint(f"object{number}")
        before = Rotation.from_quat(joint.qpos[3:], scalar_first=True)
        joint.qpos[:3] = position
        joint.qpos[3:] = (turn * before).as_quat(scalar_first=True)
        joint.qvel[:] = 0.0
        mujoco.mj_forward(self._model, self._data)

    def let_rest(self, number: int) -> None:
        """Give an object rolling friction, without which it never comes to rest on its side."""
        for geom in self._geoms(number):
            self._model.geom_condim[geom] = ROLLING_CONTACT["condim"]
            self._model.geom_friction[geom, 2] = np.array(ROLLING_CONTACT["friction"])[2]

    def set_finger_contacts(self, on: bool) -> None:
        self._model.geom_contype[self._fingers] = self._contype if on else 0
        self._model.geom_conaffinity[self._fingers] = self._conaffinity if on else 0

    def fingers_clear(self) -> bool:
        """Return whether no finger penetrates an object."""
        objects = [g for i in range(len(self._world.config.objects)) for g in self._geoms(i)]
        return all(
            mujoco.mj_geomDistance(self._model, self._data, int(f), int(g), 0.02, None) > 1e-3
            for f in self._fingers
            for g in objects
            if np.linalg.norm(self._data.geom_xpos[f] - self._data.geom_xpos[g]) < 0.2
        )

    def _geoms(self, number: int) -> list[int]:
        """Return the colliding geoms of an object."""
        body = self._model.body(f"object{number}").id
        return [
            int(geom)
            for geom in np.flatnonzero(self._model.geom_bodyid == body)
            if self._model.geom_contype[geom]
        ]
