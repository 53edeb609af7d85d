"""Exceptions of the sim_assets package; messages name the cause and the remedy."""

from collections.abc import Sequence


class SimAssetsError(Exception):
    """Base class of all exceptions of sim_assets."""


class ObjectFileError(SimAssetsError, ValueError):
    """A user's mesh file or folder is unusable; the message names the file, the reason and the remedy."""


class RobotFileError(SimAssetsError, ValueError):
    """A robot file or its MJCF is unusable.

    Attributes:
        problems: one line for each problem; each names the part, the reason and the remedy.
    """

    def __init__(self, problems: str | Sequence[str]) -> None:
        self.problems = (problems,) if isinstance(problems, str) else tuple(problems)
        super().__init__("\n".join(self.problems))
