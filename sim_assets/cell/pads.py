"""The opening between the pads of a linkage hand, which bends under load: its drivers do not tell it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from manipulation.robot import ArmDescription
from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.finger_motion import is_below
from sim_assets.robots.hand_surface import geom_points

_NEAR = 0.012  # [m] from the tool frame's axis of closing at which a geom is a pad


@dataclass(frozen=True)
class PadPoints:
    """A point on the face of each pad.

    Attributes:
        bodies: bodies of the pads at positive and negative y of the tool frame.
        points: (2, 3) points in the frames of these bodies in [m].
        site: name of the tool frame's site.
    """

    bodies: tuple[int, int]
    points: Float[np.ndarray, "2 3"]
    site: str

    def opening(self, data: Any) -> float:
        """Return the distance [m] of the points along the closing direction."""
        ends = [
            data.xpos[body] + data.xmat[body].reshape(3, 3) @ point
            for body, point in zip(self.bodies, self.points, strict=True)
        ]
        closing = data.site(self.site).xmat.reshape(3, 3)[:, 1]
        return max(float((ends[0] - ends[1]) @ closing), 0.0)


def pad_points(model: MjModel, arm: ArmDescription) -> PadPoints | None:
    """Return the pads of a hand with passive joints; None if all joints are driven, or no pads are found.

    The pads are the geoms beside the tool frame while the hand is closed.
    """
    fingers = arm.fingers
    if len(fingers.joint_names) == fingers.n_driven:
        return None
    data = mujoco.MjData(model)
    for names, values in ((arm.joint_names, arm.q_home), (fingers.joint_names, fingers.at(0.0))):
        for name, value in zip(names, values, strict=True):
            data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    site = data.site(arm.tcp_site)
    moved = [int(model.joint(name).bodyid[0]) for name in fingers.joint_names]
    found: dict[int, tuple[float, int]] = {}  # by side: distance of the nearest face, body
    for geom in np.flatnonzero(model.geom_contype):
        body = int(model.geom_bodyid[geom])
        if not any(is_below(model, body, joint) for joint in moved):
            continue
        points = geom_points(model, int(geom)) @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        points = (points - site.xpos) @ site.xmat.reshape(3, 3)
        beside = points[(np.abs(points[:, [0, 2]]) < _NEAR).all(axis=1), 1]
        if len(beside):
            side = 1 if beside.mean() > 0 else -1
            distance = float((side * beside).min())
            found[side] = min(found.get(side, (np.inf, 0)), (distance, body))
    if len(found) < 2:
        return None
    bodies = (found[1][1], found[-1][1])
    half = 0.5 * float(fingers.widths[0])
    local = [
        data.xmat[body].reshape(3, 3).T
        @ (site.xpos + side * half * site.xmat.reshape(3, 3)[:, 1] - data.xpos[body])
        for side, body in zip((1, -1), bodies, strict=True)
    ]
    return PadPoints(bodies, np.array(local), arm.tcp_site)
