"""What is found to have fallen or to lean in the box, for given pose checks."""

from dataclasses import replace

import numpy as np
import pytest

from app.task import fallen
from app.task.fallen import (
    AGREES,
    APART,
    LEANING,
    TURNED,
    fallen_objects,
    is_something_lost,
    items_left,
    left_in_box,
    with_lost_found,
    without_gone,
)
from app.task.task_types import TaskResult
from manipulation.types import Box, ObjectOutcome
from perception.geometry import pose_from_yaw, so3_exp
from perception.inference.refit import PoseCheck

AT = np.array([0.5, 0.27, 0.054])


def tilted(angle):
    T = pose_from_yaw(0.0, AT)
    T[:3, :3] = so3_exp(np.array([angle, 0.0, 0.0]))
    return T


def check(status="seen", tilt=0.0, T=None, share=0.9):
    T = tilted(tilt) if T is None else T
    return PoseCheck(T, status, share, 5000, float(np.arccos(np.clip(T[2, 2], -1, 1))), 0.0)


@pytest.fixture
def placed(can_at):
    return {id: can_at(id, 0.45 + 0.1 * id, 0.27) for id in (0, 1, 2)}


def find(placed, checks, monkeypatch, relocated=None):
    scenes = []

    def relocate(estimate, scene, T_before):
        scenes.append((estimate.id, scene, T_before))
        return relocated

    monkeypatch.setattr(fallen, "relocate", relocate)
    checks = {id: check(T=e.T_world_object) for id, e in placed.items()} | checks
    return fallen_objects(placed, checks, (), Box()), scenes


def test_what_stands_is_left_as_it_is(placed, monkeypatch) -> None:
    found, scenes = find(placed, {1: check(tilt=0.9 * LEANING), 2: check("hidden")}, monkeypatch)
    assert found == [] and scenes == []


def test_what_leans_is_placed_again_off_what_it_leans_on(placed, monkeypatch) -> None:
    leaning = tilted(1.1 * LEANING)
    leaning[0, 3] = placed[2].T_world_object[0, 3] - 0.03
    (found,), _ = find(placed, {1: check(T=leaning)}, monkeypatch)
    assert (found.id, found.resting, found.rests_on) == (1, "upright", 2)
    np.testing.assert_array_equal(found.T_world_object, leaning)


@pytest.mark.parametrize(("angle", "resting"), [(1.5, "lying"), (3.1, "upside-down"), (0.5, "upright")])
def test_what_is_not_there_is_searched_for_in_the_box(placed, monkeypatch, angle, resting) -> None:
    found, scenes = find(placed, {0: check("not_there")}, monkeypatch, check(T=tilted(angle)))
    assert [(e.id, e.resting) for e in found] == [(0, resting)]
    ((id, scene, T_before),) = scenes
    assert id == 0 and [other.id for other in scene.others] == [1, 2]
    np.testing.assert_array_equal(T_before, placed[0].T_world_object)
    (x0, x1), (y0, y1) = scene.region
    box = Box()
    assert x1 - x0 < box.size[0] and y1 - y0 < box.size[1], "the walls are no object"


@pytest.mark.parametrize(
    ("share", "elsewhere", "is_fallen"), [(0.62, 0.8, True), (0.62, 0.7, False), (0.7, 0.95, False)]
)
def test_what_agrees_in_part_is_believed_where_another_pose_explains_clearly_more(
    placed, monkeypatch, share, elsewhere, is_fallen
) -> None:
    """A lying mug agrees with the lower part of an upright one."""
    lying = check(T=tilted(1.5), share=elsewhere)
    found, _ = find(placed, {0: check(T=placed[0].T_world_object, share=share)}, monkeypatch, lying)
    assert [e.resting for e in found] == ["lying"] * is_fallen


def test_others_are_where_they_were_seen(placed, monkeypatch) -> None:
    """Depth of a neighbour that was shifted is not the fallen object's."""
    T = placed[1].T_world_object.copy()
    T[0, 3] += 0.01
    _, ((_, scene, _),) = find(placed, {0: check("not_there"), 1: check(T=T)}, monkeypatch)
    np.testing.assert_array_equal(scene.others[0].T_world_object, T)


def test_what_is_nowhere_in_the_box_or_stands_elsewhere_in_it_is_not_fallen(placed, monkeypatch) -> None:
    assert find(placed, {0: check("not_there")}, monkeypatch)[0] == []
    assert find(placed, {0: check("not_there")}, monkeypatch, check())[0] == []


@pytest.mark.parametrize(
    ("turn", "is_found"), [(1.2 * TURNED, True), (-1.2 * TURNED, True), (0.8 * TURNED, False)]
)
def test_a_mug_whose_handle_was_turned_is_placed_again(placed, monkeypatch, turn, is_found) -> None:
    placed[1] = replace(placed[1], category="mug")
    T = placed[1].T_world_object @ pose_from_yaw(turn, np.zeros(3))
    found, scenes = find(placed, {1: check(T=T)}, monkeypatch)
    assert [(e.id, e.resting, e.rests_on) for e in found] == [(1, "upright", None)] * is_found
    assert scenes == []
    if found:
        np.testing.assert_allclose(found[0].T_world_object, T, atol=1e-12)


@pytest.mark.parametrize(
    ("turns", "expected"), [((0.6, -0.5, 0.0), [0]), ((0.4, -0.5, 0.0), []), ((0.6, 0.6, -0.7), [2])]
)
def test_the_most_turned_of_mugs_whose_handles_are_not_in_line_is_placed_again(
    placed, monkeypatch, turns, expected
) -> None:
    placed = {id: replace(e, category="mug") for id, e in placed.items()}
    checks = {
        id: check(T=e.T_world_object @ pose_from_yaw(turns[id] * APART, np.zeros(3)))
        for id, e in placed.items()
    }
    found, _ = find(placed, checks, monkeypatch)
    assert [e.id for e in found] == expected


def test_a_can_that_was_turned_is_left(placed, monkeypatch) -> None:
    T = placed[1].T_world_object @ pose_from_yaw(2 * TURNED, np.zeros(3))
    assert find(placed, {1: check(T=T)}, monkeypatch)[0] == []


@pytest.mark.parametrize(
    ("angle", "resting"), [(0.0, "upright"), (np.pi / 2, "lying"), (np.pi, "upside-down")]
)
def test_what_was_not_placed_but_is_in_the_box_is_left_there(can_at, pack_plan, angle, resting) -> None:
    """Its shape is carried with its stand frame to where it was seen last."""
    T_stand = pack_plan.objects["can_1"].T_world_stand
    turn = np.eye(4)
    turn[:3, :3] = so3_exp(np.array([angle, 0.0, 0.0]))
    T_left = pose_from_yaw(0.3, np.array([0.5, 0.27, 0.05])) @ turn
    outcomes = [ObjectOutcome(1, "can_1", False, 3, "toppled", None, T_left)]
    result = TaskResult(objects=[can_at(0), can_at(1, 0.5)], plan=pack_plan, outcomes=outcomes)
    (found,) = left_in_box(result, Box())
    assert found.id == 1 and found.resting == resting
    T_stand_object = np.linalg.inv(T_stand) @ can_at(1, 0.5).T_world_object
    np.testing.assert_allclose(found.T_world_object, T_left @ T_stand_object, atol=1e-9)
    (item,) = items_left(result, [found]).values()
    np.testing.assert_array_equal(item.T_world_stand, T_left)
    assert item.vertices is pack_plan.objects["can_1"].vertices


def test_what_was_placed_or_is_beside_the_box_or_nowhere_is_not(can_at, pack_plan) -> None:
    beside, inside = (
        pose_from_yaw(0.0, np.array([0.5, -0.2, 0.0])),
        pose_from_yaw(0.0, np.array([0.5, 0.27, 0.0])),
    )
    base = TaskResult(objects=[can_at(0), can_at(1, 0.5)], plan=pack_plan)
    for outcome in (
        ObjectOutcome(1, "can_1", False, 1, "", None, beside),
        ObjectOutcome(1, "can_1", False, 1),
        ObjectOutcome(1, "can_1", True, 1, "", inside),
    ):
        assert left_in_box(replace(base, outcomes=[outcome]), Box()) == []


@pytest.mark.parametrize(("share", "is_found"), [(AGREES, True), (0.9 * AGREES, False), (None, False)])
def test_what_was_lost_is_found_where_it_lies_in_the_box(
    can_at, pack_plan, monkeypatch, share, is_found
) -> None:
    lying = tilted(1.5)
    scenes = []

    def relocate(estimate, scene):
        scenes.append((estimate.id, [other.id for other in scene.others]))
        return None if share is None else check(T=lying, share=share)

    monkeypatch.setattr(fallen, "relocate", relocate)
    objects = {id: can_at(id, 0.3 + 0.1 * id) for id in range(3)}
    plan = replace(pack_plan, objects={e.name: pack_plan.objects["can_1"] for e in objects.values()})
    inside = pose_from_yaw(0.0, np.array([0.5, 0.27, 0.004]))
    outcomes = [
        ObjectOutcome(0, "can_0", True, 1, "", inside),
        ObjectOutcome(1, "can_1", False, 1, "lost"),
        ObjectOutcome(2, "can_2", False, 1, "stuck", None, inside),
    ]
    result = TaskResult(objects=list(objects.values()), plan=plan, outcomes=outcomes)
    assert is_something_lost(result)
    latest = with_lost_found(result, (), Box())
    assert scenes == [(1, [0])], "it alone is searched for, beside what has its place"
    assert latest.outcomes[0] is outcomes[0] and latest.outcomes[2] is outcomes[2]
    assert is_something_lost(latest) is not is_found
    if is_found:
        (found,) = (e for e in left_in_box(latest, Box()) if e.id == 1)
        np.testing.assert_allclose(found.T_world_object, lying, atol=1e-9)
        assert found.resting == "lying"


@pytest.mark.parametrize(
    ("status", "is_in_box", "is_gone"),
    [("not_there", False, True), ("not_there", True, False), ("seen", False, False)],
)
def test_what_is_not_in_the_box_any_more_has_no_place(
    can_at, pack_plan, monkeypatch, status, is_in_box, is_gone
) -> None:
    monkeypatch.setattr(fallen, "relocate", lambda estimate, scene: check() if is_in_box else None)
    inside = pose_from_yaw(0.0, np.array([0.5, 0.27, 0.004]))
    outcomes = [ObjectOutcome(id, f"can_{id}", True, 1, "", inside) for id in (0, 1)]
    plan = replace(pack_plan, objects={o.name: pack_plan.objects["can_1"] for o in outcomes})
    checks = {0: check(), 1: check(status)}
    result = TaskResult(objects=[can_at(0), can_at(1, 0.5)], plan=plan, outcomes=outcomes, checks=checks)
    latest = without_gone(result, Box())
    assert [o.placed for o in latest.outcomes] == [True, not is_gone]
    assert list(latest.checks) == ([0] if is_gone else [0, 1])
    assert is_something_lost(latest) is is_gone
