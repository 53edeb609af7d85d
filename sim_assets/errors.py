"""Exceptions of the sim_assets package; messages name the cause and the remedy."""


class SimAssetsError(Exception):
    """Base class of all exceptions of sim_assets."""


class ObjectFileError(SimAssetsError, ValueError):
    """A user's mesh file or folder is unusable; the message names the file, the reason and the remedy."""


class RobotFileError(SimAssetsError, ValueError):
    """A robot file or its MJCF is unusable; the message names the file, the reason and the remedy."""
