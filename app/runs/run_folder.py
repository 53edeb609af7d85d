"""Folder of a run, written in stages so that an interrupted process leaves readable results.

A folder has one writer at a time (``lock``), and a manifest of the files that were written to it
(``manifest``). A new run in the folder of another one first moves that run's files to ``.previous``. When the
new run is complete, they are deleted; when it ends before its first result, they are moved back; when it is
killed later, they stay there until a run in this folder is complete. Files that a person put there or changed
are never deleted: changed ones are moved to ``changed_files_<time>``.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from app.errors import UsageError
from app.options import CommonOptions
from app.runs.inputs import inputs_of, require_disjoint
from app.runs.lock import LOCK_FILE, FolderLock
from app.runs.manifest import (
    MANIFEST_FILE,
    Manifest,
    is_own_folder,
    linked_folder,
    own_files,
    own_names,
    read_manifest,
    temporary_files,
)
from app.runs.report import Report
from perception.io.files import write_json

PREVIOUS = ".previous"
# A run that has written nothing else has no result yet.
_NO_RESULTS = {"report.json", "replay.glb", "replay.json", "replay.npz", "evaluation.json"}


@dataclass
class _Writing:
    """State of a folder while this process writes to it."""

    lock: FolderLock
    command: str


# Folders that this process is writing, by resolved path.
_WRITING: dict[Path, _Writing] = {}


@dataclass(frozen=True)
class RunFolder:
    """Paths of the files of a run.

    Attributes:
        path: The folder.
    """

    path: Path

    @staticmethod
    def create(
        options: CommonOptions, command: str, also_read: Sequence[Path] = (), continues: str | None = None
    ) -> RunFolder:
        """Create the folder of ``--out``, or replace a run that is stored there, and lock it.

        Args:
            options: Options of the command; the paths among them are inputs, except the outputs.
            command: Name of the run.
            also_read: Inputs that the options do not name.
            continues: First part of the names of the runs whose files are kept; None to replace any run.

        Raises:
            UsageError: The path is not a run folder, overlaps an input, is in use, or cannot be written.
        """
        stamp = time.strftime("%Y%m%d-%H%M%S")
        path = options.out or Path("runs") / f"{stamp}_{command}_seed{options.seed}"
        folder = RunFolder(path)
        with _explained(path):
            require_disjoint(path, [*inputs_of(options), *also_read])
            if path.exists() and not path.is_dir():
                raise UsageError(f"--out {path} is a file: give a folder")
            folder.require_run_or_empty()
            path.mkdir(parents=True, exist_ok=True)
            with folder.locked(command):
                folder.make_room(continues)
                Manifest(command, "running", own_files(path)).write(path)
                folder.write_report(
                    Report(command, options.seed, reason="stopped before the first stage was done")
                )
        return folder

    @staticmethod
    def resume(options: CommonOptions, out: Path, command: str) -> RunFolder:
        """Lock the folder of an interrupted run in order to continue it.

        Raises:
            UsageError: The folder is not a run folder, overlaps an input, is in use, or cannot be written.
        """
        folder = RunFolder(out)
        with _explained(out):
            require_disjoint(out, inputs_of(options))
            if not out.is_dir():
                raise UsageError(f"--out {out} is not a folder: give the folder of the run to be resumed")
            folder.require_run_or_empty()
            with folder.locked(command):
                folder.make_room(continues="")
                Manifest(command, "running", own_files(out)).write(out)
        return folder

    def write_report(self, report: Report) -> None:
        """Replace ``report.json`` atomically."""
        self.write_json("report.json", report.as_json())

    def write_json(self, name: str, value: Any) -> None:
        """Replace a JSON file atomically, and record all files written so far."""
        write_json(self.path / name, value)
        writing = _WRITING.get(self.path.resolve())
        if writing is not None:
            Manifest(writing.command, "running", own_files(self.path)).write(self.path)

    @property
    def scan(self) -> Path:
        return self.path / "scan"

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.finish(complete=kind is None)

    def finish(self, complete: bool) -> bool:
        """Record the end of the run and unlock the folder; do nothing if that is done already.

        Returns whether the run that this one would have replaced was restored.

        Args:
            complete: Whether the run ended regularly. If not, and it has no result, the run that it would
                have replaced is restored.

        Raises:
            OSError: The folder cannot be written; it is unlocked nevertheless.
        """
        writing = _WRITING.pop(self.path.resolve(), None)
        if writing is None:
            return False
        try:
            _delete(temporary_files(self.path))
            if complete:
                Manifest(writing.command, "complete", own_files(self.path)).write(self.path)
                _delete_run(self.path / PREVIOUS)
            elif self._replaced() is not None and set(own_files(self.path)) <= _NO_RESULTS:
                _delete([self.path / name for name in own_files(self.path)])
                self._restore()
                return True
            else:
                Manifest(writing.command, "running", own_files(self.path)).write(self.path)
            return False
        finally:
            writing.lock.release()

    def require_run_or_empty(self) -> None:
        """Raise UsageError if the folder has content and is not a run folder that can be replaced."""
        if not self.path.is_dir():
            return
        of_killed_run = (LOCK_FILE, f".{MANIFEST_FILE}.")
        if all(entry.name.startswith(of_killed_run) for entry in self.path.iterdir()):
            return
        if read_manifest(self.path) is None:
            raise UsageError(f"--out {self.path} is not empty and no run folder: give another folder")
        link = linked_folder(self.path) or linked_folder(self.path / PREVIOUS)
        if link is not None:
            raise UsageError(f"--out {self.path}: {link} is a symbolic link; runs do not write through links")

    @contextlib.contextmanager
    def locked(self, command: str) -> Iterator[None]:
        """Lock the folder for this process; unlock it again if the body fails."""
        key = self.path.resolve()
        RunFolder(key).finish(complete=False)  # a run of this process that was left open
        _WRITING[key] = _Writing(FolderLock(self.path), command)
        try:
            yield
        except BaseException:
            _WRITING.pop(key).lock.release()
            raise

    def make_room(self, continues: str | None) -> None:
        """Complete what a killed process left undone, and move the stored run away unless it is continued."""
        _delete(temporary_files(self.path))
        stored = read_manifest(self.path)
        if stored is None:
            return
        keep = continues is not None and stored.command.startswith(continues)
        if stored.state == "restoring" or (keep and stored.state == "replacing"):
            stored = self._restore()
        if not keep:
            self._set_aside(stored)

    def _set_aside(self, stored: Manifest) -> None:
        """Move the stored run to ``.previous``, and changed files to a folder that is kept.

        An incomplete run is deleted instead if the run before it is still in ``.previous``.
        """
        previous = self.path / PREVIOUS
        if stored.state == "complete" or (stored.state == "running" and self._replaced() is None):
            _delete_run(previous)
            sizes = own_files(self.path)
            recorded = sizes if stored.state == "running" else stored.files
            files = {name: sizes.get(name, 0) if size is None else size for name, size in recorded.items()}
            Manifest(stored.command, stored.state, files).write(previous)
            stored = Manifest(stored.command, "replacing", files)
            stored.write(self.path)
        changed = self.path / time.strftime("changed_files_%Y%m%d-%H%M%S")
        for name in own_names(self.path):
            if not stored.owns(self.path, name):
                _move(self.path, changed, name)
            elif stored.state == "running":
                (self.path / name).unlink()
            else:
                _move(self.path, previous, name)
        _remove_empty_folders(self.path)

    def _replaced(self) -> Manifest | None:
        """Return the manifest of the replaced run; None if there is none."""
        previous = self.path / PREVIOUS
        return read_manifest(previous) if (previous / MANIFEST_FILE).is_file() else None

    def _restore(self) -> Manifest:
        """Move the replaced run back, and return its manifest."""
        replaced = self._replaced() or Manifest("", "complete", own_files(self.path))
        replace(replaced, state="restoring").write(self.path)
        for name in own_files(self.path / PREVIOUS):
            _move(self.path / PREVIOUS, self.path, name)
        replaced.write(self.path)
        _delete_run(self.path / PREVIOUS)
        return replaced


def finish_all(complete: bool) -> list[Path]:
    """Finish the run folders that this process has open; return those that hold the run, not a restored one.

    Raises:
        OSError: A folder cannot be written.
    """
    return [path for path in list(_WRITING) if not RunFolder(path).finish(complete)]


def replaced_runs(folders: Iterable[Path]) -> list[Path]:
    """Return where the runs are that incomplete runs in these folders have replaced."""
    return [folder / PREVIOUS for folder in folders if (folder / PREVIOUS / MANIFEST_FILE).is_file()]


def open_folders() -> list[Path]:
    """Return the run folders that this process is writing."""
    return list(_WRITING)


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn errors of the file system into UsageError."""
    try:
        yield
    except (OSError, RuntimeError) as error:  # RuntimeError: a loop of symbolic links
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"--out {path} cannot be written ({reason}): give another folder") from None


def _move(source: Path, target: Path, name: str) -> None:
    (target / name).parent.mkdir(parents=True, exist_ok=True)
    os.replace(source / name, target / name)


def _delete(paths: Iterable[Path]) -> None:
    for path in paths:
        path.unlink(missing_ok=True)


def _delete_run(folder: Path) -> None:
    """Delete the files of a run, its manifest last, and the folders that are empty then."""
    if not folder.is_dir():
        return
    _delete(temporary_files(folder))
    _delete(folder / name for name in own_files(folder))
    _delete([folder / MANIFEST_FILE])
    _remove_empty_folders(folder)
    with contextlib.suppress(OSError):
        folder.rmdir()


def _remove_empty_folders(folder: Path) -> None:
    """Remove the empty folders that runs create, innermost first."""
    for place, _, _ in os.walk(folder, topdown=False):
        if is_own_folder(os.path.relpath(place, folder)):
            with contextlib.suppress(OSError):  # not empty
                os.rmdir(place)
