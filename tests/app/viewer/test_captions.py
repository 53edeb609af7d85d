"""Captions of stages and actions."""

from typing import get_args

from app.task.run_observer import Stage
from app.viewer.captions import ACTION_CAPTIONS, STAGE_CAPTIONS, action_caption, stage_caption
from app.viewer.snapshot import SLAM_STAGES, STAGE_TITLES, TASK_STAGES
from manipulation.execution import Phase


def test_every_stage_and_phase_has_a_caption():
    assert tuple(TASK_STAGES) == get_args(Stage)
    assert STAGE_CAPTIONS.keys() == STAGE_TITLES.keys() == TASK_STAGES.keys() | SLAM_STAGES.keys()
    assert ACTION_CAPTIONS.keys() == set(get_args(Phase))
    assert all(caption.count("{}") == 1 for caption in ACTION_CAPTIONS.values())


def test_captions_name_the_object_and_the_reason():
    action = {"phase": "grasp", "name": "mug_2", "message": ""}
    assert action_caption(action) == "Grasping mug 2"
    assert (
        action_caption(action | {"phase": "failed", "message": "no grasp"}) == "mug 2 is not placed: no grasp"
    )
    assert action_caption(action | {"phase": "wave {}"}) == "wave {} mug 2"
    assert stage_caption("plan") == "Planning the goal poses and their order" and stage_caption("new") == ""
