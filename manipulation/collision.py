"""Collision checks of the arm and a carried object against perceived objects and static obstacles.

The collision world is a MuJoCo model of the arm's MJCF and the perceived meshes alone (``collision_model``).
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from manipulation.arm_model import joint_addresses, mujoco, site_index
from manipulation.collision_model import OFF, ROBOT, WORLD, Body, collision_model
from manipulation.errors import ManipulationError
from manipulation.obstacles import Obstacle
from manipulation.robot import ArmDescription
from perception.obstacles.obstacle import PerceivedObstacle


@dataclass(frozen=True)
class CollisionConfig:
    """Clearances and sampling of the checks.

    Attributes:
        robot_margin: smallest clearance of the robot in [m].
        carried_margin: smallest clearance of the carried object in [m].
        perceived_margin: further clearance of robot and carried object from perceived obstacles in [m].
        joint_step: largest joint step between two checked postures of a path in [rad].
    """

    robot_margin: float = 0.004
    carried_margin: float = 0.004
    perceived_margin: float = 0.001
    joint_step: float = 0.03


@dataclass(frozen=True)
class AllowedContacts:
    """Contacts that are no collisions, and the clearances from everything else.

    Attributes:
        touch: names of objects or obstacles that the robot may touch.
        touch_carried: names of objects or obstacles that the carried object may touch.
        slide_carried: names of those that it slides along, with the depth [m] by which it may enter them.
        robot_margin, carried_margin: clearances in [m]; those of the configuration if None.
    """

    touch: frozenset[str] = frozenset()
    touch_carried: frozenset[str] = frozenset()
    slide_carried: Mapping[str, float] = field(default_factory=dict)
    robot_margin: float | None = None
    carried_margin: float | None = None


NO_CONTACT = AllowedContacts()


@dataclass(frozen=True)
class Contact:
    """A collision found by a check.

    Attributes:
        mover: "arm" or the name of the carried object.
        obstacle: name of the object, obstacle or link that it collides with.
        link: name of the link that collides; empty for a carried object.
    """

    mover: str
    obstacle: str
    link: str = field(default="", compare=False)

    def __str__(self) -> str:
        return f"collide with {self.obstacle}" + (f" ({self.link})" if self.link else "")


class CollisionWorld:
    """Checks postures of the arm, with or without a carried object, for collisions.

    The world is mutable: objects are moved, attached to the hand and released in the course of a plan.
    Links are checked against each other but for those of ``self_collision.link_contacts``. Links that turn
    about the vertical alone are not checked against the table: their distance to it depends on the mounting.

    Attributes:
        config: that of the constructor.
        links: names of the links whose pose is not fixed by that of the hand.
        perceived: names of the obstacles of perceived geometry.
    """

    def __init__(
        self,
        arm: ArmDescription,
        bodies: Sequence[Body],
        obstacles: Sequence[Obstacle | PerceivedObstacle],
        config: CollisionConfig = CollisionConfig(),
    ) -> None:
        self.config = config
        self._arm = arm
        self._model = collision_model(arm, bodies, obstacles, config.perceived_margin).compile()
        self._data = mujoco.MjData(self._model)
        self._address = joint_addresses(self._model, arm.joint_names)
        self._fingers = joint_addresses(self._model, arm.fingers.joint_names)
        self._owner = [self._owner_of(geom) for geom in range(self._model.ngeom)]
        self._geoms = [np.flatnonzero(self._model.geom_bodyid == body) for body in range(self._model.nbody)]
        self._robot_bodies = [
            body
            for body in range(1, self._model.nbody)
            if not self._model.body(body).name.startswith(("world/", "carried/"))
        ]
        self.links = self._links_before_hand()
        self.perceived = frozenset(o.name for o in obstacles if isinstance(o, PerceivedObstacle))
        self._contents: dict[str, tuple[str, ...]] = {}
        self._carried: tuple[str, ...] = ()
        self._poses = {b.name: np.array(b.T_world_object) for b in bodies}
        self._pieces = {b.name: b.pieces for b in bodies}
        self._T_hand_tcp = self._tcp_in_hand()
        for body in bodies:
            self.move(body.name, body.T_world_object)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects, in the order of construction."""
        return tuple(self._poses)

    def pose(self, name: str) -> Float[np.ndarray, "4 4"]:
        """Return ``T_world_object`` of the object's last pose outside the hand."""
        return self._poses[name].copy()

    def move(self, name: str, T_world_object: Float[np.ndarray, "4 4"]) -> None:
        """Set the pose of an object.

        Raises:
            ManipulationError: there is no object of that name.
        """
        self._check_name(name)
        self._poses[name] = T = np.array(T_world_object, dtype=np.float64)
        self._set_body_pose(f"world/{name}", T)

    def base(self, name: str) -> float:
        """Return the height [m] of the lowest point of an object at its last pose outside the hand."""
        T = self._poses[name]
        return min(float((piece @ T[2, :3]).min()) for piece in self._pieces[name]) + float(T[2, 3])

    def center(self, name: str) -> Float[np.ndarray, "3"]:
        """Return the middle [m] of the pieces of an object in the world, or of an obstacle."""
        geoms = self._geoms[self._body_id(f"world/{name}")]
        mujoco.mj_kinematics(self._model, self._data)
        return self._data.geom_xpos[geoms].mean(axis=0)

    def set_present(self, name: str, present: bool) -> None:
        """Enable or disable the object in the world."""
        self._check_name(name)
        self._switch(f"world/{name}", *((WORLD, ROBOT) if present else (OFF, OFF)))

    @contextlib.contextmanager
    def containing(self, name: str, contents: Sequence[str]) -> Iterator[None]:
        """Carry other objects with an object whenever it is carried, each where it is in that one."""
        self._contents[name] = tuple(contents)
        try:
            yield
        finally:
            self.release()
            del self._contents[name]

    def carry(self, name: str, T_tcp_object: Float[np.ndarray, "4 4"]) -> None:
        """Attach the object to the hand at ``T_tcp_object`` and disable it in the world."""
        self.release()
        self._carried = (name, *self._contents.get(name, ()))
        T_tcp_world = T_tcp_object @ np.linalg.inv(self._poses[name])
        for carried in self._carried:
            T_tcp_carried = T_tcp_object if carried == name else T_tcp_world @ self._poses[carried]
            self.set_present(carried, False)
            self._set_body_pose(f"carried/{carried}", self._T_hand_tcp @ T_tcp_carried)
            self._switch(f"carried/{carried}", ROBOT, WORLD)

    def release(self) -> None:
        """Detach what is carried, if anything, and enable it in the world at its last pose there."""
        for carried in self._carried:
            self._switch(f"carried/{carried}", OFF, OFF)
            self.set_present(carried, True)
        self._carried = ()

    def contact(
        self, q: Float[np.ndarray, "n"], width: float, allowed: AllowedContacts = NO_CONTACT
    ) -> Contact | None:
        """Return the first collision of a posture, or None if it is free.

        Args:
            q: (n,) joint positions in [rad].
            width: opening between the pads in [m].
            allowed: contacts that are no collisions.
        """
        for mover, other, distance in self._contacts(q, width, allowed):
            obstacle = other.removeprefix("world/")
            if mover.startswith("carried/"):
                slides = distance > -allowed.slide_carried.get(obstacle, -np.inf)
                if not slides and obstacle not in allowed.touch_carried:
                    return Contact(mover.removeprefix("carried/"), obstacle)
            elif other.startswith("world/"):
                if obstacle not in allowed.touch:
                    return Contact("arm", obstacle, mover)
            elif distance < 0:
                return Contact("arm", obstacle, mover)
        return None

    def touched(self, q: Float[np.ndarray, "n"], width: float) -> frozenset[str]:
        """Return the names of the objects and obstacles that the robot is in contact with in a posture."""
        others = (other for _, other, _ in self._contacts(q, width, NO_CONTACT))
        return frozenset(other.removeprefix("world/") for other in others if other.startswith("world/"))

    def carried_overlaps(self, q: Float[np.ndarray, "n"], width: float) -> dict[str, float]:
        """Return how deep [m] the carried object is in others, by name; distances are negative depths."""
        depths: dict[str, float] = {}
        for mover, other, distance in self._contacts(q, width, NO_CONTACT):
            if mover.startswith("carried/"):
                name = other.removeprefix("world/")
                depths[name] = max(depths.get(name, -np.inf), -distance)
        return depths

    def path_contact(
        self, postures: Float[np.ndarray, "k n"], width: float, allowed: AllowedContacts = NO_CONTACT
    ) -> Contact | None:
        """Return the first collision along the straight joint segments between postures [rad], or None."""
        contacts = (self.contact(q, width, allowed) for q in densify(postures, self.config.joint_step))
        return next((contact for contact in contacts if contact is not None), None)

    def _contacts(
        self, q: np.ndarray, width: float, allowed: AllowedContacts
    ) -> Iterator[tuple[str, str, float]]:
        """Yield the bodies of each contact in a posture, that of the robot first, and their distance [m]."""
        self._apply_margins(allowed)
        data, model = self._data, self._model
        data.qpos[self._address] = q
        data.qpos[self._fingers] = self._arm.fingers.at(width)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        for (first, second), distance in zip(data.contact.geom, data.contact.dist, strict=True):
            mover, other = self._owner[first], self._owner[second]
            yield (other, mover, distance) if mover.startswith("world/") else (mover, other, distance)

    def _apply_margins(self, allowed: AllowedContacts) -> None:
        def either(requested: float | None, default: float) -> float:
            return default if requested is None else requested

        self._set_margin(self._robot_bodies, either(allowed.robot_margin, self.config.robot_margin))
        carried = [self._body_id(f"carried/{name}") for name in self._carried]
        self._set_margin(carried, either(allowed.carried_margin, self.config.carried_margin))

    def _set_margin(self, bodies: Sequence[int], margin: float) -> None:
        for body in bodies:
            self._model.geom_margin[self._geoms[body]] = margin
            self._model.body_margin[body] = margin

    def _links_before_hand(self) -> frozenset[str]:
        """Return the names of the links before the last joint of the arm."""
        model = self._model
        last = model.joint(self._arm.joint_names[-1]).bodyid[0]
        names = set()
        for body in self._robot_bodies:
            above = body
            while above not in (0, last):
                above = model.body_parentid[above]
            if above == 0:
                names.add(model.body(body).name)
        return frozenset(names)

    def _owner_of(self, geom: int) -> str:
        return self._model.body(self._model.geom_bodyid[geom]).name

    def _body_id(self, name: str) -> int:
        return self._model.body(name).id

    def _switch(self, body: str, contype: int, conaffinity: int) -> None:
        """Set the contact bits of a body and its geoms; MuJoCo's broad phase reads those of the body."""
        index = self._body_id(body)
        self._model.geom_contype[self._geoms[index]] = self._model.body_contype[index] = contype
        self._model.geom_conaffinity[self._geoms[index]] = self._model.body_conaffinity[index] = conaffinity

    def _check_name(self, name: str) -> None:
        if name not in self._poses:
            raise ManipulationError(
                f"no object '{name}' in the collision world; it has {', '.join(self.names)}"
            )

    def _set_body_pose(self, body: str, T: np.ndarray) -> None:
        index = self._body_id(body)
        self._model.body_pos[index] = T[:3, 3]
        self._model.body_quat[index] = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)

    def _tcp_in_hand(self) -> np.ndarray:
        site = site_index(self._model, self._arm.tcp_site)
        T = np.eye(4)
        T[:3, 3] = self._model.site_pos[site]
        T[:3, :3] = Rotation.from_quat(self._model.site_quat[site], scalar_first=True).as_matrix()
        return T


def densify(postures: Float[np.ndarray, "k n"], step: float) -> Float[np.ndarray, "m n"]:
    """Return postures [rad] along the straight joint segments, at most ``step`` [rad] apart in any joint."""
    pieces = [postures[:1]]
    for start, end in itertools.pairwise(postures):
        count = max(int(np.ceil(np.abs(end - start).max() / step)), 1)
        pieces.append(start + (end - start) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(pieces)
