"""Writable caches for libraries: compiled kernels of warp, fonts of matplotlib.

Where the home folder cannot be written, as in many containers, both get a folder of this user below the
temporary one.
"""

from __future__ import annotations

import os
import stat
from collections.abc import MutableMapping
from pathlib import Path

_VARIABLES = {"WARP_CACHE_PATH": "warp", "MPLCONFIGDIR": "matplotlib"}


def use_writable_caches(environment: MutableMapping[str, str] = os.environ) -> None:
    """Set the libraries' cache folders if those in use cannot be written."""
    for variable, name in _VARIABLES.items():
        if not _is_writable(_folder(variable, name, environment)):
            environment[variable] = str(_temporary(environment) / name)


def _folder(variable: str, name: str, environment: MutableMapping[str, str]) -> Path:
    """Return the folder that the library will use."""
    if environment.get(variable):
        return Path(environment[variable])
    cache = environment.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(cache) / name


def _is_writable(folder: Path) -> bool:
    if not folder.is_absolute():  # the home folder is unknown
        return False
    probe = folder / f".nodeslam-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.close(os.open(probe, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
        probe.unlink()
    except OSError:
        return False
    return True


def _temporary(environment: MutableMapping[str, str]) -> Path:
    """Return a cache folder that no other user can write to: libraries execute what they find there."""
    path = Path(environment.get("TMPDIR") or "/tmp") / f"nodeslam-cache-{os.getuid()}"
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        status = path.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077:
            return path
    except OSError:
        pass
    import tempfile

    return Path(tempfile.mkdtemp(prefix="nodeslam-cache-"))
