"""Errors that the command line turns into one line and an exit code."""


class AppError(Exception):
    """Root of what app raises on purpose."""


class UsageError(AppError):
    """The command line asks for something impossible; the message says what to give instead. Exit code 2."""


class MissingExtraError(AppError):
    """A library of an optional extra is absent; the message says how to install it. Exit code 2."""
