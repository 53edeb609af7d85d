"""Whether the scan needs a further image, and from where."""

from __future__ import annotations

from collections.abc import Sequence

from manipulation.errors import PlanningError
from manipulation.grasps import grasp_candidates
from manipulation.next_view import next_viewpoint, risk_of
from manipulation.planner import ManipulationConfig
from manipulation.robot import ArmDescription
from manipulation.standing import to_standing
from manipulation.viewpoints import Viewpoint
from perception.types import ObjectEstimate, RejectedObject

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
