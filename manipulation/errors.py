"""Exceptions of the manipulation package."""


class ManipulationError(Exception):
    """Base class of all exceptions that the manipulation package raises."""


class PlanningError(ManipulationError):
    """No plan exists under the given settings; the message counts the failures and names a remedy."""


class NoPlanError(PlanningError):
    """No motion is feasible for one object.

    Attributes:
        blockers: names of the objects and things that are in the way, the most frequent first.
        is_enclosed: whether no path was found from the present posture to an object that could be grasped.
    """

    def __init__(self, message: str, blockers: tuple[str, ...] = (), is_enclosed: bool = False) -> None:
        super().__init__(message)
        self.blockers, self.is_enclosed = blockers, is_enclosed


class RobotError(ManipulationError):
    """The robot rejected a command or failed to execute it."""


class ApproachBlockedError(RobotError):
    """The empty hand met something on its way to an object."""


class GoalBlockedError(RobotError):
    """An object in the hand met something on its way to its goal; it was set down where possible."""


class RobotStoppedError(ManipulationError):
    """The robot was stopped, or stopped itself, and accepts no motion; the task ends with this reason."""


class GraspFailedError(ManipulationError):
    """The hand closed without holding the object, or the object was lost."""


class UnknownInTheWayError(GraspFailedError):
    """An image shows something unknown where the hand, or what it holds, was about to go."""


class LeaningError(GraspFailedError):
    """An object leans in the one that it was put into; its pose in the planner's world is as it was seen."""


class SceneChangedError(ManipulationError):
    """The object is not where the plan expects it; nothing was touched."""
