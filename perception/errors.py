"""Errors of the perception package; messages say what is wrong, where, and what to do."""


class PerceptionError(Exception):
    """Base class of the errors of the perception package."""


class InvalidInputError(PerceptionError, ValueError):
    """An input value or file is invalid; the message says what, where, and what to do."""


def install_hint(extra: str) -> str:
    """Return how to install an optional extra from a clone; the package is not on a package index."""
    return f"run pip install '.[{extra}]' in a clone of NodeSLAM"
