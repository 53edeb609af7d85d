"""Validation of the fields of notes."""

from typing import get_args

import numpy as np
import pytest

from app.runs.note_schema import COVARIANCE_TRIANGLE, REQUIRED, check_note, is_finite_number
from app.runs.replay import NoteKind

EYE = np.eye(4).tolist()
SHEAR = (np.eye(4) + np.eye(4, k=1)).tolist()
VALID = {
    "stage": {"name": "scan"},
    "done": {"name": "scan", "seconds": 2},
    "look": {"index": 0},
    "found": {"index": 1, "count": 0},
    "fit": {
        "id": 0, "category": "mug", "iteration": 8, "code": [0.5] * 16, "T_world_object": EYE,
        "scale": [0.1, 0.1, 0.2], "residual": None,
    },
    "objects": {"covariances": {"0": [1e-6] * COVARIANCE_TRIANGLE}},
    "obstacles": {"pieces": {"thing_0": [[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.5]]]}},
    "plan": {
        "placements": [{"name": "mug_0", "T_world_stand": EYE, "position": [0, 0, 0], "yaws": []}],
        "left_out": {"can_1": "out of reach"},
    },
    "action": {"phase": "approach", "name": "mug_0", "message": "", "T_stand_tcp": EYE, "grasps": [EYE]},
    "path": {"points": [[0, 0, 0], [1.5, 0, 0]]},
}  # fmt: skip


def test_valid_notes_pass_and_every_field_is_required():
    assert VALID.keys() == REQUIRED.keys() == set(get_args(NoteKind))
    for kind, data in VALID.items():
        check_note(kind, data | {"extra": 1})
        for name in REQUIRED[kind]:
            with pytest.raises(ValueError, match=f"{name} is missing"):
                check_note(kind, {key: value for key, value in data.items() if key != name})


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        ("done", {"seconds": -1}, "seconds must not be negative"),
        ("fit", {"residual": -0.1}, "residual must not be negative"),
        ("fit", {"scale": [True, 1, 1]}, "scale must hold 3 finite numbers"),
        ("path", {"points": [[0, 0, 0], [0, 0, 1e5]]}, "points .* of at most 10000 in magnitude"),
        ("stage", {"name": 3}, "name must be text"),
        ("done", {"seconds": "2"}, "seconds must be a finite number"),
        ("done", {"seconds": True}, "seconds must be a finite number"),
        ("look", {"index": -1}, "index must be a non-negative integer"),
        ("look", {"index": 0.0}, "index must be a non-negative integer"),
        ("found", {"count": True}, "count must be a non-negative integer"),
        ("fit", {"category": "plate"}, "category must be one of"),
        ("fit", {"category": ["mug"]}, "category must be one of"),
        ("fit", {"code": [0.5] * 15}, "code must hold 16 finite numbers"),
        ("fit", {"code": [float("nan")] * 16}, "code must hold 16 finite numbers"),
        ("fit", {"code": ["a"] * 16}, "code must hold 16 finite numbers"),
        ("fit", {"code": [1e200] * 16}, "code must hold 16 finite numbers"),
        ("fit", {"T_world_object": SHEAR}, "T_world_object .*rigid"),
        ("fit", {"T_world_object": [[1, 2], [3]]}, "T_world_object must hold 4 x 4 finite numbers"),
        ("fit", {"scale": [0.1, 0, 0.1]}, "scale must be positive"),
        ("fit", {"residual": "small"}, "residual must be a finite number"),
        ("objects", {"covariances": []}, "covariances must be an object"),
        ("objects", {"covariances": {"4": [1.0]}}, "covariances of 4 must hold 325 finite numbers"),
        ("obstacles", {"pieces": []}, "pieces must be an object"),
        ("obstacles", {"pieces": {"thing_0": []}}, "pieces of thing_0 must be a list of pieces"),
        ("obstacles", {"pieces": {"thing_0": [[[0, 0, 0]]]}}, "pieces of thing_0 .* at least 4 points"),
        ("plan", {"placements": {}}, "placements must be a list"),
        ("plan", {"placements": [3]}, "placements must hold objects"),
        ("plan", {"placements": [{"name": "mug_0"}]}, "placements 0: T_world_stand is missing"),
        ("plan", {"left_out": {"can_1": None}}, "left_out of can_1 must be text"),
        ("action", {"T_stand_tcp": [1]}, "T_stand_tcp must hold 4 x 4 finite numbers"),
        ("action", {"grasps": [EYE, SHEAR]}, "grasps .*rigid"),
        ("action", {"grasps": EYE[0][0]}, "grasps must be a list"),
        ("path", {"points": [[0, 0, 0]]}, "points must hold at least 2 points"),
        ("path", {"name": None}, "name must be text"),
        ("action", {"total": "3"}, "total must be a non-negative integer"),
        ("path", {"points": [[0, 0], [1, 1]]}, "points must hold n x 3 finite numbers"),
    ],
)
def test_an_invalid_field_is_named(kind, changes, message):
    with pytest.raises(ValueError, match=message):
        check_note(kind, VALID[kind] | changes)


def test_grasp_candidates_need_the_selected_grasp():
    action = {key: value for key, value in VALID["action"].items() if key != "T_stand_tcp"}
    check_note("action", action | {"grasps": []})
    with pytest.raises(ValueError, match="T_stand_tcp is missing"):
        check_note("action", action)


def test_numbers_are_in_the_range_of_a_float():
    assert all(is_finite_number(value) for value in (0, -1.5, 10**300))
    assert not any(
        is_finite_number(value) for value in (float("nan"), float("-inf"), 10**400, True, "1", None)
    )
