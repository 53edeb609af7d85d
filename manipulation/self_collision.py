"""Pairs of links whose contact is no collision, found from the arm's own collision geoms.

Neighbouring links overlap at their joint by design, and so do some others. As usual in motion planning, the
pairs to ignore are found by sampling postures: those that touch at home or in most postures.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from manipulation.arm_model import MjModel, collision_spec, joint_addresses, joint_range, mujoco
from manipulation.robot import ArmDescription

_SAMPLES = 100  # random postures
_MOSTLY = 0.4  # share of postures in contact from which a pair is ignored
_VERTICAL = 0.999  # cosine


@dataclass(frozen=True)
class LinkContacts:
    """Contacts of an arm that its collision checks ignore.

    Attributes:
        ignored: pairs of links that are neighbours, belong to one rigid group or to the hand, touch at home,
            or touch in most postures.
        level: links that turn about a vertical axis alone, whose height above the table never changes.
    """

    ignored: frozenset[tuple[str, str]]
    level: frozenset[str]


def link_contacts(arm: ArmDescription) -> LinkContacts:
    """Return the contacts to ignore; computed once per arm."""
    return _link_contacts(arm.mjcf, arm.joint_names, tuple(map(float, arm.q_home)))


@functools.lru_cache(maxsize=8)
def _link_contacts(mjcf: str, joint_names: tuple[str, ...], home: tuple[float, ...]) -> LinkContacts:
    spec = collision_spec(mjcf)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 1
    model = spec.compile()
    groups = _rigid_groups(model, joint_names)
    counts = np.zeros((model.nbody, model.nbody))
    touching_home = np.zeros_like(counts, dtype=bool)
    data = mujoco.MjData(model)
    addresses = joint_addresses(model, joint_names)
    low, high = joint_range(model, joint_names)
    rng = np.random.default_rng(0)
    for index, q in enumerate([np.array(home), *rng.uniform(low, high, (_SAMPLES, len(low)))]):
        data.qpos[addresses] = q
        touching = _touching(model, data)
        counts += touching
        if index == 0:
            touching_home = touching
    names = [model.body(body).name for body in range(model.nbody)]
    ignored = set()
    for a, b in itertools.combinations(range(1, model.nbody), 2):
        neighbours = abs(groups[a] - groups[b]) <= 1
        if neighbours or touching_home[a, b] or counts[a, b] > _MOSTLY * _SAMPLES:
            ignored.add((names[a], names[b]))
    level = (
        {names[b] for b in range(1, model.nbody) if groups[b] == 1} if _first_is_vertical(model) else set()
    )
    return LinkContacts(frozenset(ignored), frozenset(level))


def _rigid_groups(model: MjModel, joint_names: tuple[str, ...]) -> np.ndarray:
    """Return for each body the number of arm joints above it, so that the whole hand is one group."""
    of_joint = {int(model.joint(name).bodyid[0]) for name in joint_names}
    groups = np.zeros(model.nbody, dtype=int)
    for body in range(1, model.nbody):
        groups[body] = groups[model.body_parentid[body]] + (body in of_joint)
    return groups


def _touching(model: MjModel, data: Any) -> np.ndarray:
    """Return which bodies touch in the present posture, (nbody, nbody)."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    touching = np.zeros((model.nbody, model.nbody), dtype=bool)
    for (first, second), distance in zip(data.contact.geom, data.contact.dist, strict=True):
        if distance < 0:
            a, b = model.geom_bodyid[first], model.geom_bodyid[second]
            touching[a, b] = touching[b, a] = True
    return touching


def _first_is_vertical(model: MjModel) -> bool:
    """Return whether the first joint's axis is vertical."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return bool(model.njnt and abs(data.xaxis[0, 2]) > _VERTICAL)
