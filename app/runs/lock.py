"""Exclusive use of a folder by one process.

The kernel holds the lock (``flock``) and releases it when the process ends, whatever ended it. The lock file
names the holder: ``{"pid": process id, "started": time of the lock}``.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
from pathlib import Path

from app.errors import UsageError

LOCK_FILE = ".nodeslam.lock"


class FolderLock:
    """Lock of a folder, from construction until ``release``."""

    def __init__(self, folder: Path) -> None:
        """Lock a folder; take over the lock file of a process that has ended.

        Raises:
            UsageError: Another process holds the lock.
            OSError: The lock file cannot be created.
        """
        self._path = folder / LOCK_FILE
        self._handle = -1
        while self._handle < 0:
            self._handle = _locked(self._path, folder)
        started = time.strftime("%Y-%m-%d %H:%M:%S")
        content = json.dumps({"pid": os.getpid(), "started": started}).encode()
        try:
            os.ftruncate(self._handle, 0)
            os.pwrite(self._handle, content, 0)
        except OSError:  # full disk: the lock holds without its description
            pass

    def release(self) -> None:
        """Remove the lock file and unlock the folder; do nothing if that is done already."""
        if self._handle < 0:
            return
        self._path.unlink(missing_ok=True)
        os.close(self._handle)
        self._handle = -1


def _locked(path: Path, folder: Path) -> int:
    """Return the descriptor of the locked file; -1 if its former holder removed the file meanwhile."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if _is_at(handle, path):
            return handle
    except BlockingIOError:
        holder = _holder(handle)
        os.close(handle)
        raise UsageError(
            f"--out {folder} is in use by another run{holder}: wait for it or give another folder"
        ) from None
    except BaseException:
        os.close(handle)
        raise
    os.close(handle)
    return -1


def _is_at(handle: int, path: Path) -> bool:
    """Return whether the open file is still the one at the path."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path, follow_symlinks=False))
    except FileNotFoundError:
        return False


def _holder(handle: int) -> str:
    """Return a description of the process that holds the lock; empty if it is not written yet."""
    try:
        content = json.loads(os.pread(handle, 1000, 0))
        return f" (process {int(content['pid'])}, started {content['started']})"
    except (OSError, ValueError, KeyError, TypeError):
        return ""
