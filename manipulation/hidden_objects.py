"""Stand-ins for what is below an object and has not been seen: it will need a place in the box, too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from manipulation.lying_grasps import lies
from manipulation.standing import RAISED_ALONE
from manipulation.types import StandingObject
from perception.geometry import pose_from_yaw
from perception.types import ObjectEstimate

SHARE = 0.95  # of the hand's opening that the diameter is
_SIDES = 24


def hidden_objects(
    objects: Sequence[ObjectEstimate], items: Mapping[str, StandingObject], opening: float
) -> list[StandingObject]:
    """Return a cylinder below each upright object whose support is unknown, as high as the base of that.

    Args:
        objects: object map.
        items: its objects by name; those that are missing count as supported.
        opening: of the hand, which just holds the cylinders, in [m].
    """
    found = []
    for estimate in objects:
        item = items.get(estimate.name)
        if item is None or estimate.rests_on is not None or lies(item.T_world_stand):
            continue
        height = float(item.T_world_stand[2, 3])
        if height >= RAISED_ALONE:
            found.append(_cylinder(item, SHARE * opening / 2, height))
    return found


def _cylinder(above: StandingObject, radius: float, height: float) -> StandingObject:
    import trimesh  # slow to import

    mesh = trimesh.creation.cylinder(radius, height, sections=_SIDES)
    mesh.apply_translation([0.0, 0.0, height / 2])
    foot = np.array([*above.T_world_stand[:2, 3], 0.0])
    return StandingObject(
        id=above.id,
        name=f"hidden_{above.id}",
        category="can",
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces),
        T_world_stand=pose_from_yaw(0.0, foot),
        size=height,
        is_round=True,
    )
