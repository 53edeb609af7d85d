"""Errors that the command line reports as one line with exit code 2."""

from collections.abc import Sequence


class AppError(Exception):
    """Base class of the errors that app raises."""


class UsageError(AppError):
    """The command line requests something impossible; the message names a valid alternative."""


class StalledError(AppError):
    """A stage made no progress for its time limit; the message names it."""


class ProblemsError(UsageError):
    """Input with several problems.

    Attributes:
        problems: one line for each.
    """

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(self.problems))


class MissingExtraError(AppError):
    """A library of an optional extra is not installed; the message names the extra."""
