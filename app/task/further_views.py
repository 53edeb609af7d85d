"""Whether the scan needs further images, and from where."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from manipulation.errors import PlanningError
from manipulation.grasps import grasp_candidates
from manipulation.next_view import next_viewpoint, risk_of
from manipulation.planner import ManipulationConfig
from manipulation.robot import ArmDescription
from manipulation.standing import to_standing
from manipulation.viewpoints import Viewpoint
from perception.detection.geometry import project
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import ObjectEstimate, RejectedObject, RgbdFrame

WHOLE = 0.98  # share of an object's vertices within an image, from which on that shows it whole
BORDER = 8  # [pixels] of the image beside which they are not within it
VIEWS = 2  # that show it whole, at least, if there are as many
MOST_CLOSER = 3  # objects that are looked at from nearby at a time
WORTH_A_LOOK = 0.1  # least score of an object that was rejected: other images may show what it is


def most_useful_viewpoint(
    objects: Sequence[ObjectEstimate],
    rejected: Sequence[RejectedObject],
    viewpoints: Sequence[Viewpoint],
    arm: ArmDescription,
    config: ManipulationConfig,
) -> Viewpoint | None:
    """Return the viewpoint of the next image; None if none is worth its time.

    Args:
        objects: Object map so far.
        rejected: Detected objects that are not in it.
        viewpoints: Viewpoints without an image so far, the most informative first; at least one.
        arm: Description of the arm.
        config: Settings of manipulation.
    """
    grasp = config.for_arm(arm).pick_place.grasp
    risks: dict[int, float] = {}
    for estimate in objects:
        if estimate.resting == "upright":
            try:
                item = to_standing(estimate, config.support)
            except PlanningError:  # leans too much, which another image may contradict
                risks[estimate.id] = 1.0
                continue
            risks[estimate.id] = risk_of(estimate, item, grasp_candidates(item, grasp), grasp.gripper)
    found = next_viewpoint(objects, risks, viewpoints)
    if found is None and any(item.score >= WORTH_A_LOOK for item in rejected):
        return viewpoints[0]
    return found


def cut_by_borders(
    objects: Sequence[ObjectEstimate], frames: Sequence[RgbdFrame]
) -> list[tuple[float, float]]:
    """Return the places (x, y) [m] of the objects that fewer than ``VIEWS`` images show whole.

    Of a bottle whose body is beyond the border in most of them the neck may be taken for its body.

    Args:
        objects: Object map.
        frames: Images with camera poses.
    """
    least = min(VIEWS, len(frames))
    cut = [e for e in objects if sum(_shows_whole(frame, e) for frame in frames) < least]
    return [(float(x), float(y)) for x, y in (e.T_world_object[:2, 3] for e in cut)]


def things_never_whole(
    obstacles: Sequence[PerceivedObstacle], frames: Sequence[RgbdFrame]
) -> list[tuple[float, float]]:
    """Return the places (x, y) [m] of the things of no class that no image shows whole.

    They may be objects: what they are cannot have been seen.

    Args:
        obstacles: Things of no class.
        frames: Images with camera poses.
    """

    def is_whole(thing: PerceivedObstacle) -> bool:
        corners = np.concatenate(thing.pieces)
        return any(_is_within(frame, corners) for frame in frames)

    middles = [thing.bounds.mean(axis=0) for thing in obstacles if not is_whole(thing)]
    return [(float(x), float(y)) for x, y, _ in middles]


def _shows_whole(frame: RgbdFrame, estimate: ObjectEstimate) -> bool:
    """Return whether almost all of an object is within an image, whatever hides it."""
    return _is_within(frame, estimate.mesh_world.vertices)


def _is_within(frame: RgbdFrame, points: Float[np.ndarray, "n 3"]) -> bool:
    """Return whether almost all of some world points [m] are within an image."""
    pixels, depth = project(frame, points)
    size = np.array([frame.intrinsics.width, frame.intrinsics.height])
    inside = ((pixels >= BORDER) & (pixels < size - BORDER)).all(axis=1) & (depth > 0)
    return bool(inside.mean() > WHOLE)
