"""Errors of the perception package: one root, messages a person can act on."""


class PerceptionError(Exception):
    """Root of everything that perception raises on purpose."""


class InvalidInputError(PerceptionError, ValueError):
    """A value or a file from outside is unusable; the message says what, where, and what to do."""


def install_hint(extra: str) -> str:
    """Return how to install an optional extra; the package is on no index, so from a clone."""
    return f"run pip install '.[{extra}]' in a clone of NodeSLAM"
