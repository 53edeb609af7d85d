"""What has become of the objects of a task so far, and which of them get another chance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from manipulation.observation import Poses
from manipulation.types import ObjectOutcome, Placement
from perception.geometry import rigid


class TaskProgress:
    """Goals and outcomes of the objects of one task.

    Args:
        ids: ids of all objects by name.
        placements: goals in the order of the task.
        release_height: height above its resting pose at which an object on the floor is released, in [m].

    Attributes:
        goals: goals by name; that of an object that is set aside in order to be put back is added.
        outcomes: outcomes by name, in the order of completion.
    """

    def __init__(
        self, ids: Mapping[str, int], placements: Sequence[Placement], release_height: float
    ) -> None:
        self._ids, self._release_height = ids, release_height
        self.goals = {placement.name: placement for placement in placements}
        self.outcomes: dict[str, ObjectOutcome] = {}
        self._first: dict[str, ObjectOutcome] = {}  # outcomes of objects that get, or had, another chance

    def record(self, outcome: ObjectOutcome) -> None:
        """Set the outcome of an object."""
        self.outcomes[outcome.name] = outcome

    def reopen(self, name: str) -> bool:
        """Forget the outcome of an object that is to be placed again; return whether there was one."""
        return self.outcomes.pop(name, None) is not None

    def before(self, name: str) -> ObjectOutcome | None:
        """Return the outcome after which an object got another chance; None if it had one chance so far."""
        return self._first.get(name)

    def gets_another_chance(self, outcome: ObjectOutcome) -> bool:
        """Return whether an object that was not placed may be tried once more, which is noted."""
        if outcome.placed or outcome.name in self._first:
            return False
        self._first[outcome.name] = outcome
        return True

    def is_placed(self, name: str) -> bool:
        """Return whether an object of the task was placed."""
        return name in self.outcomes and self.outcomes[name].placed

    def placed(self) -> set[str]:
        """Return the names of the objects that were placed."""
        return {name for name, outcome in self.outcomes.items() if outcome.placed}

    def waits_for_stack(self, placement: Placement, besides: str = "") -> bool:
        """Return whether a bowl below an object has not been processed.

        Args:
            placement: goal of the object.
            besides: name of an object that counts as processed.
        """
        return any(n in self.goals and n not in self.outcomes and n != besides for n in placement.stack)

    def with_placed_stack(self, placement: Placement, poses: Poses, besides: str = "") -> Placement:
        """Return the placement with its stack reduced to the bowls that were placed, at the uppermost one.

        Args:
            placement: goal of an object.
            poses: T_world_stand of the objects; a bowl may have moved when it was released or pressed.
            besides: name of an object that counts as placed.
        """
        if not placement.stack:
            return placement
        stack = tuple(n for n in placement.stack if n not in self.goals or n == besides or self.is_placed(n))
        if not stack:
            return replace(placement, stack=(), release_height=self._release_height)
        x, y = poses[stack[-1]][:2, 3]
        return replace(placement, stack=stack, position=(float(x), float(y), placement.position[2]))

    def below_others(self) -> set[str]:
        """Return the names of the bowls into which another one has been put."""
        return {below for done in self.outcomes for below in self.goals[done].stack}

    def failed_attempt(self, name: str, attempts: int, reason: str) -> ObjectOutcome:
        """Return the outcome of an object that is not placed, with the attempts of its first chance.

        Args:
            name: name of the object.
            attempts: executed grasps of the present chance.
            reason: cause.
        """
        first = self._first.get(name)
        attempts += first.attempts if first else 0
        return ObjectOutcome(self._ids[name], name, False, attempts, reason)

    def give_up(self, names: Iterable[str], reason: str) -> list[ObjectOutcome]:
        """Record that the robot was stopped while it handled the first of some objects."""
        outcomes = [self.failed_attempt(name, int(index == 0), reason) for index, name in enumerate(names)]
        for outcome in outcomes:
            self.record(outcome)
        return outcomes

    def results(self, poses: Poses) -> list[ObjectOutcome]:
        """Return all outcomes, with the poses in which the objects are now.

        A bowl may have moved when another one was put into it, and others as something came down beside them.
        Objects that were placed keep the direction in which they are to stand: that of a mug is verified.

        Args:
            poses: T_world_stand of the objects of known pose.
        """

        def with_pose(outcome: ObjectOutcome) -> ObjectOutcome:
            T = poses.get(outcome.name)
            if not outcome.placed:
                return replace(outcome, T_world_left=T)
            if T is None or outcome.T_world_stand is None:
                return outcome
            return replace(outcome, T_world_stand=rigid(outcome.T_world_stand[:3, :3], T[:3, 3]))

        return [with_pose(outcome) for outcome in self.outcomes.values()]
