"""Exceptions of the manipulation package."""


class ManipulationError(Exception):
    """Base class of all exceptions that the manipulation package raises."""


class PlanningError(ManipulationError):
    """No plan exists under the given settings; the message counts the failures and names a remedy."""


class RobotError(ManipulationError):
    """The robot rejected a command or failed to execute it."""


class RobotStoppedError(ManipulationError):
    """The robot was stopped, or stopped itself, and accepts no motion; the task ends with this reason."""
