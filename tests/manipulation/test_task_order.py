"""Order of turns, with a planner that only knows which goals enclose which."""

import pytest

from manipulation.task_order import TaskOrder
from manipulation.types import Placement


class Enclosing:
    """``closed`` holds pairs: the place of the first is enclosed once the second is at its own."""

    def __init__(self, *closed):
        self.closed = set(closed)

    def can_place_after(self, placement, before):
        return not any((placement.name, goal.name) in self.closed for goal in before)


def goal(name, stack=()):
    return Placement(name, (0.0, 0.0, 0.0), (0.0,), tuple(stack))


def order_of(*names, closed=(), blocked=None):
    order = TaskOrder([goal(name) for name in names], Enclosing(*closed))
    for name, blockers in (blocked or {}).items():
        order.note_blockers(name, blockers)
    return order


def names(order):
    return [placement.name for placement in order]


def test_what_follows_is_what_gets_the_next_turn():
    order = order_of("a", "b", "c", blocked={"c": ["x"]})
    assert order.following("y").name == "a" and order.following("x").name == "c"
    assert order.following("y", but=["a", "b"]).name == "c" and order.following("x", but="abc") is None
    order.put_unblocked_first("x")
    assert order.next().name == "c"


def test_what_needs_no_turn_gets_none():
    order = order_of("a", "b", "c")
    order.drop("b")
    order.drop("d")
    assert names(order) == ["a", "c"]


def test_turns_follow_the_task_and_can_be_changed():
    order = order_of("a", "b", "c")
    first = order.next()
    assert first.name == "a" and len(order) == 2
    order.put_last(first)
    assert names(order) == ["b", "c", "a"]
    order.put_before(list(order)[2], goal("d"))
    assert names(order) == ["a", "d", "b", "c"]
    order.put_first(goal("x"), goal("y"))
    assert names(order)[:3] == ["x", "y", "a"]


def test_what_an_object_blocked_comes_next_once_it_is_moved_in_the_tasks_order():
    order = order_of("a", "b", "c", "d", blocked={"b": ["z"], "d": ["y", "z"], "a": ["y"]})
    order.put_unblocked_first("z")
    assert names(order) == ["b", "d", "a", "c"]


@pytest.mark.parametrize(
    ("closed", "waits_for_stack", "remedy"),
    [
        ((), False, "none"),  # it may wait: its place stays open
        ((("a", "c"),), False, "set aside"),  # what is in the way would enclose it
        ((("a", "b"),), False, "placed first"),  # one between them would
        ((("a", "b"),), True, "set aside"),
        ((("a", "b"), ("b", "c")), False, "set aside"),  # the blocker would enclose another's place
    ],
)
def test_remedy_for_what_is_in_an_objects_way(closed, waits_for_stack, remedy):
    order = order_of("a", "b", "c", closed=closed, blocked={"a": ["c", "b"]})
    placement = order.next()
    blocker = order.first_blocker("a")
    assert blocker.name == "c" and order.remedy(placement, blocker, waits_for_stack) == remedy
    if remedy != "none":
        assert order.remedy(placement, blocker, waits_for_stack) == "none", "each pair is considered once"


@pytest.mark.parametrize(
    ("stacks", "remedy"),
    [({"a": ["c"]}, "none"), ({"c": ["a"]}, "set aside")],
    ids=["lower-one-in-the-way", "upper-one-in-the-way"],
)
def test_of_bowls_of_one_stack_the_lower_one_comes_first(stacks, remedy):
    """What stands in the lower one already, as in nested bowls on the table, is set aside."""
    order = TaskOrder([goal(name, stacks.get(name, ())) for name in "abc"], Enclosing(("a", "c")))
    order.note_blockers("a", ["c"])
    assert order.remedy(order.next(), order.first_blocker("a"), waits_for_stack=False) == remedy


def test_what_does_not_wait_is_no_first_blocker():
    order = order_of("a", "b", closed=[("a", "b")], blocked={"a": ["table", "b"]})
    assert order.next().name == "a" and order.first_blocker("a") is None
