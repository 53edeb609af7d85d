"""Which geoms of a user's arm are solid, and the contacts of its fingers."""

from __future__ import annotations

from collections.abc import Mapping

from sim_assets.rendering.headless import MjsBody, MjSpec
from sim_assets.robots.jaw_meshes import split_meshes
from sim_assets.robots.simulated_arm import ARM_CONTACT, PAD_CONTACT

COLLISION_GROUP = 3


def set_contacts(spec: MjSpec, wrist: str) -> None:
    """Set collision filters (none within the arm or with visual geoms) and the contacts of the fingers.

    Args:
        spec: the arm.
        wrist: name of its last joint; empty or unknown for an arm without a hand.
    """
    for body in spec.bodies:
        geoms = list(body.geoms)
        solid = [geom for geom in geoms if geom.group == COLLISION_GROUP]
        solid = solid or [geom for geom in geoms if geom.contype or geom.conaffinity]
        if not solid and _is_base(body):
            solid = geoms  # what stands on the table is seen and avoided, whatever the file collides
        for geom in geoms:
            touches = any(geom is other for other in solid)
            _set(geom, ARM_CONTACT if touches else {"contype": 0, "conaffinity": 0})
    last = spec.joint(wrist) if wrist else None
    if last is not None:
        one_jaw = _count_joints(last.parent) == 2
        if one_jaw:
            split_meshes(spec, last.parent)
        fixed_jaw = list(last.parent.geoms) if one_jaw else []
        for geom in (*fixed_jaw, *_geoms_of_moving(last.parent, moving=False)):
            if is_solid(geom):
                _set(geom, PAD_CONTACT)


def _geoms_of_moving(body: MjsBody, moving: bool) -> list:
    """Return the geoms of the bodies that joints below ``body`` move."""
    found = list(body.geoms) if moving else []
    for child in body.bodies:
        found += _geoms_of_moving(child, moving or len(child.joints) > 0)
    return found


def is_solid(geom: object) -> bool:
    """Return whether a geom of a loaded specification is a collision geom."""
    return bool(geom.contype)  # type: ignore[attr-defined]


def _is_base(body: MjsBody) -> bool:
    """Return whether a body is fixed to the world but not the world itself."""
    fixed = body.name != "world"
    while fixed and body.name != "world":
        fixed, body = not body.joints, body.parent
    return fixed


def _count_joints(body: MjsBody) -> int:
    """Return the number of joints of a body and of all below it."""
    return len(body.joints) + sum(map(_count_joints, body.bodies))


def _set(geom: object, values: Mapping[str, object]) -> None:
    for name, value in values.items():
        setattr(geom, name, value)
