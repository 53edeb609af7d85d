"""Errors of the manipulation package."""


class ManipulationError(Exception):
    """Root of everything that manipulation raises on purpose."""


class PlanningError(ManipulationError):
    """No plan exists under the given settings; the message counts what failed and names a remedy."""


class RobotError(ManipulationError):
    """The robot refused or could not carry out a command."""
