"""The parts of an arm found in its model: joints from base to wrist, and the joints that drive the hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.errors import UsageError
from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.finger_motion import hand_joints, is_below, sweep_hand
from sim_assets.robots.hand_shape import measure_hand
from sim_assets.robots.servos import actuators_of

_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
MIN_AXES = 4  # of an arm


@dataclass(frozen=True)
class Chain:
    """Joints of an arm.

    Attributes:
        root: body at which the arm begins, if the model has further parts with joints or the body was given;
            else empty.
        joints: names of the hinges from base to wrist.
        fingers: names of the one or two joints that drive the hand.
        assumptions: what was chosen among several possibilities.
    """

    root: str
    joints: tuple[str, ...]
    fingers: tuple[str, ...]
    assumptions: tuple[str, ...]


def find_chain(model: MjModel, root: str = "") -> Chain:
    """Find the arm and its hand: the arm ends where the chain branches into fingers.

    Args:
        model: the compiled arm.
        root: body that carries the arm's first joint, or the whole arm; empty for the first arm.

    Raises:
        UsageError: there is no arm with a hand in the model; the message says what is missing.
    """
    roots = [b for b in range(1, model.nbody) if model.body_parentid[b] == 0 and _joints_below(model, b)]
    if not roots:
        raise UsageError("the model has no joints: give the MJCF of an arm")
    body, assumptions = _root_of_arm(model, roots, root)
    chain = _serial_chain(model, body)
    if len(chain) < MIN_AXES:
        raise UsageError(
            f"only {len(chain)} hinges lead from body '{model.body(body).name}' to the hand: an arm needs at "
            f"least {MIN_AXES}; scenes with other mechanisms need --body"
        )
    joints = tuple(model.joint(j).name for j in chain)
    endless = ", ".join(f"'{model.joint(j).name}'" for j in chain if not model.jnt_limited[j])
    if endless:
        assumptions += (f"joints without a range turn by up to 360 degrees either way: {endless}",)
    hand = hand_joints(model, joints)
    if not hand and _ends_with_jaw(model, joints):
        joints, hand = joints[:-1], chain[-1:]
        assumptions += (f"joint '{model.joint(chain[-1]).name}' moves one jaw, the other is fixed",)
    if not hand:
        sites = ", ".join(model.site(s).name for s in range(model.nsite) if model.site(s).name)
        raise UsageError(
            f"the arm ends at joint '{joints[-1]}' without a hand: give --hand HAND.xml --mount SITE; its "
            f"sites are {sites or 'none'}"
        )
    alone = len(roots) == 1 and body == roots[0]
    return Chain(root if alone else model.body(body).name, joints, _driven(model, hand), assumptions)


def _ends_with_jaw(model: MjModel, joints: tuple[str, ...]) -> bool:
    """Return whether the last joint of a chain opens a jaw opposite to a fixed one."""
    if len(joints) <= MIN_AXES or not model.jnt_limited[model.joint(joints[-1]).id]:
        return False
    arm, jaw = joints[:-1], joints[-1]
    try:
        measure_hand(model, arm, sweep_hand(model, arm, (jaw,)))
    except RobotFileError:
        return False
    return True


def _root_of_arm(model: MjModel, roots: list[int], name: str) -> tuple[int, tuple[str, ...]]:
    """Return the body at which the arm begins, and what was assumed about it.

    Raises:
        UsageError: no body has that name.
    """
    names = [model.body(b).name for b in roots]
    if name:
        found = [b for b in range(1, model.nbody) if model.body(b).name == name and _joints_below(model, b)]
        if not found:
            known = [*names, *(model.body(b).name for b in _arms(model) if b not in roots)]
            raise UsageError(f"--body {name} is no body with joints; there are {', '.join(known)}")
        return found[0], ()
    if len(_serial_chain(model, roots[0])) >= MIN_AXES:
        several = (f"body '{names[0]}' of {', '.join(names)} is the arm (--body)",) if len(roots) > 1 else ()
        return roots[0], several
    arms = _arms(model)
    if not arms:
        return roots[0], ()
    known = ", ".join(model.body(b).name for b in arms)
    text = f"body '{model.body(arms[0]).name}' of {known} is the arm (--body); joints before it are held"
    return arms[0], (text,)


def _arms(model: MjModel) -> list[int]:
    """Return the bodies with the first joint of each chain of hinges that leads to a hand."""
    starts, used = [], set()
    for body in range(1, model.nbody):
        if model.body_jntnum[body] == 0 or int(model.body_jntadr[body]) in used:
            continue
        chain = _serial_chain(model, body)
        used.update(chain)
        if len(chain) >= MIN_AXES and hand_joints(model, [model.joint(j).name for j in chain]):
            starts.append(body)
    return starts


def _joints_below(model: MjModel, body: int) -> list[int]:
    return [j for j in range(model.njnt) if is_below(model, int(model.jnt_bodyid[j]), body)]


def _serial_chain(model: MjModel, body: int) -> list[int]:
    """Return the hinges from a body outwards until the chain branches, slides or ends in a hand."""
    chain: list[int] = []
    while True:
        own = [j for j in range(model.njnt) if model.jnt_bodyid[j] == body]
        if any(model.jnt_type[j] != _HINGE for j in own):
            return chain
        chain += own
        children = [b for b in range(1, model.nbody) if model.body_parentid[b] == body]
        jointed = [b for b in children if _joints_below(model, b)]
        if len(jointed) != 1 or _is_hand(model, jointed[0]):
            return chain
        body = jointed[0]


def _is_hand(model: MjModel, body: int) -> bool:
    """Return whether a branch is a hand from a file of its own, by the prefix of its names."""
    from sim_assets.robots.mounting import HAND_PREFIX

    return all(model.joint(j).name.startswith(HAND_PREFIX) for j in _joints_below(model, body))


def _driven(model: MjModel, hand: list[int]) -> tuple[str, ...]:
    """Return the one or two joints that drive the hand: those with actuators, else the outermost."""
    driven = [j for j in hand if actuators_of(model, [j])]
    if len(driven) not in (1, 2):
        pool = driven or hand
        slides = [j for j in pool if model.jnt_type[j] == _SLIDE]
        tops = slides or [j for j in pool if not _parents_in(model, j, pool)]
        tops.sort(key=lambda j: -len(_joints_below(model, int(model.jnt_bodyid[j]))))
        driven = sorted(tops[:2])
    if len(driven) == 1:
        driven += _partners(model, driven[0], hand)
    return tuple(model.joint(j).name for j in driven[:2])


def _parents_in(model: MjModel, joint: int, joints: list[int]) -> bool:
    body = int(model.jnt_bodyid[joint])
    return any(other != joint and is_below(model, body, int(model.jnt_bodyid[other])) for other in joints)


def _partners(model: MjModel, joint: int, hand: list[int]) -> list[int]:
    """Return the hand joints that an equality makes mirror a joint one to one."""
    partners = []
    for e in range(model.neq):
        if model.eq_type[e] != mujoco.mjtEq.mjEQ_JOINT:
            continue
        pair = {int(model.eq_obj1id[e]), int(model.eq_obj2id[e])}
        if joint in pair and np.isclose(abs(model.eq_data[e, 1]), 1.0):
            partners += [other for other in pair - {joint} if other in hand]
    return partners
