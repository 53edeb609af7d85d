"""What an episode with a fault counts as."""

import numpy as np
import pytest

from app.options import PackOptions
from app.runs.report import ObjectReport
from app.task import faults
from app.task.faults import faulty_robot, judge_fault
from app.task.task_types import TaskResult
from manipulation.types import ObjectOutcome
from perception.geometry import pose_from_yaw


def judge(placed, *, position=(0.5, -0.2, 0.0), claimed=(), number=1):
    reports = [ObjectReport(i, "can", ok, reason="" if ok else "gone") for i, ok in enumerate(placed)]
    outcomes = [ObjectOutcome(i, f"can_{i}", i in claimed, 1) for i in range(len(placed))]
    poses = {number: pose_from_yaw(0.0, np.array(position))}
    record = {"kind": "move", "object": number, "time": 3.0}
    return judge_fault(record, reports, TaskResult(outcomes=outcomes), poses)


def test_all_in_place_is_complete():
    fault = judge([True, True])
    assert fault["complete"] and fault["reported"] and not fault["lost"] and fault["kind"] == "move"


@pytest.mark.parametrize("position", [(0.5, -0.2, -0.7), (0.3, 2.5, 0.3), (0.8, -0.5, 0.0)])
def test_a_lost_object_counts_as_complete_if_it_is_reported_and_the_rest_is_in_place(position):
    assert judge([True, False], position=position)["complete"]
    assert not judge([True, False], position=position, claimed=(1,))["complete"], "claimed to be placed"
    assert not judge([False, False], position=position)["complete"]


def test_an_object_within_reach_must_be_placed():
    fault = judge([True, False])
    assert not fault["complete"] and fault["reported"] and fault["reason"] == "gone"


def test_a_fault_that_did_not_occur_changes_nothing():
    record = {"kind": "slip", "object": None, "time": None}
    fault = judge_fault(record, [ObjectReport(0, "can", True)], TaskResult(), {})
    assert fault["complete"] and not fault["lost"] and fault["reason"] == ""


def test_kinds_take_turns_over_the_seeds(monkeypatch):
    monkeypatch.setattr("sim_assets.cell.faults.FaultyRobot", lambda world, kind, seed: (kind, seed))
    assert faulty_robot(None, PackOptions()) is None
    assert faulty_robot(None, PackOptions(fault="slip", seed=4)) == ("slip", 4)
    kinds = {faulty_robot(None, PackOptions(fault="any", seed=seed))[0] for seed in range(5)}
    assert len(kinds) == 5 and faults.REACH < 1
