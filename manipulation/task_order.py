"""Order in which the objects of a task get their turn: that of the task, unless one is in another's way."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Sequence
from typing import Literal, Protocol, runtime_checkable

from manipulation.types import Placement

Remedy = Literal["none", "placed first", "set aside"]


@runtime_checkable
class Places(Protocol):
    """Knows which places others enclose."""

    def can_place_after(self, placement: Placement, before: Sequence[Placement]) -> bool:
        """Return whether an object has a free release at its goal once others are at their own."""
        ...


class TaskOrder:
    """The objects that wait for their turn, and what blocked them so far.

    Args:
        placements: goals in the order of the task.
        places: the planner, whose scene follows what is seen.
    """

    def __init__(self, placements: Sequence[Placement], places: Places) -> None:
        self._places = places
        self._queue = deque(placements)
        self._blockers: dict[str, Sequence[str]] = {}  # of objects that had no plan
        self._made_way: set[tuple[str, str]] = set()  # objects and those that were moved before them

    def __len__(self) -> int:
        return len(self._queue)

    def __iter__(self) -> Iterator[Placement]:
        return iter(self._queue)

    def next(self) -> Placement:
        """Remove and return the goal whose turn it is."""
        return self._queue.popleft()

    def put_first(self, *goals: Placement) -> None:
        """Give goals the next turns, in their order."""
        self._queue.extendleft(reversed(goals))

    def put_last(self, goal: Placement) -> None:
        """Give a goal the last turn."""
        self._queue.append(goal)

    def drop(self, name: str) -> None:
        """Remove the goal of an object that needs no turn."""
        self._queue = deque(goal for goal in self._queue if goal.name != name)

    def note_blockers(self, name: str, blockers: Sequence[str]) -> None:
        """Remember what blocks an object that had no plan, in descending order of importance."""
        self._blockers[name] = blockers

    def put_unblocked_first(self, moved: str) -> None:
        """Put those first that an object blocked before it was moved.

        They are next in the task's order, and what comes later may block their goals.
        """
        self._queue = deque(self._unblocked_first(moved))

    def following(self, moved: str, but: Collection[str] = ()) -> Placement | None:
        """Return the goal whose turn it will be once an object has been moved; None for none.

        Args:
            moved: name of the object.
            but: names of those that will need no turn then.
        """
        return next((goal for goal in self._unblocked_first(moved) if goal.name not in but), None)

    def _unblocked_first(self, moved: str) -> list[Placement]:
        return sorted(self._queue, key=lambda p: moved not in self._blockers.get(p.name, ()))

    def first_blocker(self, name: str) -> Placement | None:
        """Return the goal of what is most in an object's way, if it waits too."""
        blocker = next(iter(self._blockers.get(name, ())), "")
        return next((goal for goal in self._queue if goal.name == blocker), None)

    def remedy(self, placement: Placement, blocker: Placement, waits_for_stack: bool) -> Remedy:
        """Return what helps an object that another one blocks.

        The layout is free in its order. An object waits if its place is not enclosed by then,
        what is in its way comes first if it encloses no place of those before it, and is else set aside.
        A bowl in its way that is to go into it, as the upper one of nested bowls, is set aside. A pair is
        considered once.

        Args:
            placement: goal of the object; it is not among the waiting ones.
            blocker: its ``first_blocker``.
            waits_for_stack: whether the blocker goes into a bowl that has not been placed.
        """
        name, places = placement.name, self._places
        if (name, blocker.name) in self._made_way:
            return "none"
        waiting = list(self._queue)
        earlier = [placement, *waiting[: waiting.index(blocker)]]
        goes_into = name in blocker.stack
        is_below = blocker.name in placement.stack
        if is_below or (not goes_into and places.can_place_after(placement, [*earlier[1:], blocker])):
            return "none"
        self._made_way.add((name, blocker.name))
        if goes_into:
            return "set aside"
        encloses = any(not places.can_place_after(other, [blocker]) for other in earlier)
        return "set aside" if encloses or waits_for_stack else "placed first"

    def put_before(self, goal: Placement, placement: Placement) -> None:
        """Give a waiting goal the next turn, and the one after it to another."""
        self._queue.remove(goal)
        self.put_first(goal, placement)
