"""Errors that the command line reports as one line with exit code 2."""


class AppError(Exception):
    """Base class of the errors that app raises."""


class UsageError(AppError):
    """The command line requests something impossible; the message names a valid alternative."""


class StalledError(AppError):
    """A stage made no progress for its time limit; the message names it."""


class MissingExtraError(AppError):
    """A library of an optional extra is not installed; the message names the extra."""
