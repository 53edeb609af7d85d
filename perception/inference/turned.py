"""Check of a mug's handle by depth: whether it points to another direction than expected.

A pose fit from the expected pose does not find the handle elsewhere: beside the surface of the body, depth of
the handle is out of its reach. Where the handle is not seen where it is expected, the mug is therefore turned
about the axis of its body in steps, each with a fit of its own, and the number of pixels that agree decides.
It was turned only if depth shows the handle there: where the handle is hidden, a little more agreement of
the body with what is measured says nothing about it. Nor was it turned where the yaw network sees about the
expected direction: an inaccurate shape and the walls of a box mislead depth. Small turns are found by the fit
from the expected pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from perception.geometry import nearest_yaw, wrapped_angle
from perception.inference.handle import body_axis
from perception.inference.handle_depth import shows_handle
from perception.inference.pose_search import PoseSearch, RefitConfig
from perception.inference.refit import PoseCheck, checked
from perception.rendering.pose import ObjectPose
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

TURNS = np.deg2rad(np.arange(15, 360, 15))  # about the axis of the body, of the initial poses
CLEARLY = 0.05  # share of the visible pixels by which a turned mug must explain more
AS_EXPECTED = np.deg2rad(30.0)  # between the pose and what the network sees, up to which they agree


def refit_turned(
    estimate: ObjectEstimate,
    frames: Sequence[RgbdFrame],
    T_expected: Float[np.ndarray, "4 4"],
    others: Sequence[ObjectEstimate] = (),
    plane: SupportPlane = SupportPlane(),
    config: RefitConfig = RefitConfig(),
    see_yaw: Callable[[ObjectEstimate], float | None] | None = None,
) -> PoseCheck | None:
    """Find an upright mug near its expected pose whose handle does not point where it is expected.

    Args:
        estimate, frames, T_expected, others, plane, config: As those of ``refit_pose``.
        see_yaw: Returns the direction of the handle about z that the network sees, in radians, for the
            mug at its pose; None if it is not sure. Where it agrees with the expected one, the mug was not
            turned. It is no evidence for a turn: of 22 mugs in boxes whose handles were as expected,
            it was sure of another direction for six. None to go by depth alone.

    Returns:
        The check at the pose with the handle elsewhere; None if the images do not clearly show it there.
    """
    search = PoseSearch(estimate, frames, T_expected, others, plane, config)
    expected = ObjectPose.of(T_expected, search.scale)
    ahead = search.refine(expected)
    at_place = replace(estimate, T_world_object=ahead.T_world_object)
    if shows_handle(at_place, frames, others):
        return None
    yaw = None if see_yaw is None else see_yaw(at_place)
    if yaw is not None and abs(wrapped_angle(yaw - nearest_yaw(ahead.T_world_object))) <= AS_EXPECTED:
        return None
    about = body_axis(estimate)
    last_pass = config.reaches[-1:]  # a wider reach lets the handle's depth shift the body
    starts = (ahead.turned(np.array([0.0, 0.0, turn]), about) for turn in TURNS)
    turned = max((search.refine(start, last_pass) for start in starts), key=search.gain)
    least = search.gain(ahead) + CLEARLY * sum(search.evidence(ahead))
    if search.gain(turned) <= least:
        return None
    is_seen = shows_handle(replace(estimate, T_world_object=turned.T_world_object), frames, others)
    return checked(search, turned, expected) if is_seen else None
