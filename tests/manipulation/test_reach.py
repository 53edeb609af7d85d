"""Objects within the arm's reach."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation.grasp_config import GraspConfig
from manipulation.grasps import grasp_candidates
from manipulation.kinematics import IkResult, IkStatus, Kinematics
from manipulation.reach import reaches_any
from manipulation.standing import to_standing


@pytest.mark.parametrize(("x", "expected"), [(0.5, True), (1.05, False)])
def test_an_object_far_away_is_out_of_reach(shapes, arm, x, expected):
    item = to_standing(shapes.estimate(1, "can", shapes.can(), x=x, y=-0.2))
    assert reaches_any(Kinematics(arm), item.name, item.T_world_stand, grasp_candidates(item)) is expected


def test_one_grasp_of_few_within_reach_is_enough(shapes, arm, monkeypatch):
    """A short list of grasps is checked in full: neighbours on it may be far apart."""
    kinematics = Kinematics(arm)
    item = to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.2))
    grasps = grasp_candidates(item, GraspConfig())
    few = replace(grasps, grasps=grasps.grasps[:3])
    checked = []

    def only_the_last(T_goal, seeds, frame="tcp", name="target"):
        checked.append(T_goal)
        status: IkStatus = "converged" if len(checked) == 3 else "not_converged"
        return IkResult(np.array(arm.q_home), status, 0.0, 0.0, 1)

    monkeypatch.setattr(kinematics, "inverse", only_the_last)
    assert reaches_any(kinematics, item.name, item.T_world_stand, few) and len(checked) == 3
