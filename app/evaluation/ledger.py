"""Ledger of an evaluation: one line of results for each finished job, appended at once.

An interrupted evaluation continues with ``--resume`` from the lines that are whole; damaged ones are dropped
with a warning, and their jobs are repeated.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from app.errors import UsageError
from app.options import WorkerOptions
from app.runs.run_folder import RunFolder
from perception.io.files import (
    MAX_TEXT_BYTES,
    parse_json,
    read_bytes,
    read_json,
    write_atomically,
    write_json,
)

logger = logging.getLogger(__name__)

SETTINGS = "evaluation.json"
_KIND = "evaluation"  # entry of the settings with the kind of evaluation

Line = dict[str, Any]


@dataclass(frozen=True)
class LedgerFormat:
    """What the lines of an evaluation's ledger hold.

    Attributes:
        evaluation: Name of the evaluation, such as ``evaluate-tasks``.
        file: Name of the file in the run folder.
        key: Entry of a line that identifies its job: a number or a text.
        check: Raises an exception for a line that cannot be used.
    """

    evaluation: str
    file: str
    key: str
    check: Callable[[Line], object] = lambda line: None


@dataclass(frozen=True)
class Ledger:
    """Results of finished jobs: a file in the run folder with one JSON object per line.

    Attributes:
        folder: Run folder.
        path: File.
        format: What its lines hold.
    """

    folder: RunFolder
    path: Path
    format: LedgerFormat

    @staticmethod
    def open(
        options: WorkerOptions, format: LedgerFormat, settings: Mapping[str, Any]
    ) -> tuple[Ledger, dict[Hashable, Line]]:
        """Open the ledger; return it with its finished lines by key. Without ``--resume`` it is empty.

        Raises:
            UsageError: There is nothing to resume, or it has other settings.
        """
        settings = {**settings, _KIND: format.evaluation}
        if not options.resume:
            folder = RunFolder.create(options, format.evaluation)
            write_json(folder.path / SETTINGS, settings)
            return Ledger(folder, folder.path / format.file, format), {}
        if options.out is None:
            raise UsageError("--resume needs --out with the folder to continue in")
        _compare_settings(options.out / SETTINGS, settings, type(options))
        folder = RunFolder.resume(options, options.out, format.evaluation)
        ledger = Ledger(folder, options.out / format.file, format)
        return ledger, ledger.read()

    def append(self, line: Line) -> None:
        """Append a line and flush it to disk."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def read(self) -> dict[Hashable, Line]:
        """Read the finished lines by key; unusable lines are dropped, so that their jobs are repeated.

        Unusable are truncated and otherwise damaged lines, and repetitions of a key. The file is replaced by
        the usable ones.
        """
        lines: dict[Hashable, Line] = {}
        try:
            content = read_bytes(self.path, MAX_TEXT_BYTES)
        except FileNotFoundError:
            return lines
        whole = []
        for number, data in enumerate(content.splitlines(), start=1):
            if not data.strip():
                continue
            try:
                line = parse_json(data, nan_allowed=True)  # scores of empty sets
                key = line[self.format.key]
                if type(key) not in (int, str):
                    raise TypeError(f"{self.format.key} is {type(key).__name__}")
                if key in lines:
                    raise ValueError(f"{self.format.key} {key} is there already")
                self.format.check(line)
            except Exception as error:  # whatever the check does with a damaged line
                logger.warning(
                    "%s, line %d is dropped and its job repeated (%s: %s)",
                    self.path, number, type(error).__name__, " ".join(str(error).split())[:200],
                )  # fmt: skip
                continue
            lines[key] = line
            whole.append(data)
        intact = b"".join(data + b"\n" for data in whole)
        if intact != content:
            write_atomically(self.path, intact)
        return lines


def _compare_settings(path: Path, settings: Mapping[str, Any], kind: type[WorkerOptions]) -> None:
    """Raise UsageError if an evaluation was stored with other settings."""
    remedy = "give the --out of the evaluation to be resumed"
    kept = read_json(path, remedy)
    if not isinstance(kept, dict):
        raise UsageError(f"{path} does not hold the settings of an evaluation: {remedy}")
    if kept.get(_KIND, settings[_KIND]) != settings[_KIND]:
        raise UsageError(f"--resume: {path.parent} belongs to {kept[_KIND]}, not to {settings[_KIND]}")
    # Options that a stored evaluation lacks had their defaults.
    before = {name: str(getattr(kind, name, None)) for name in settings} | kept
    different = sorted(name for name in settings if name != _KIND and before[name] != settings[name])
    if different:
        raise UsageError(f"--resume: {path.parent} was made with another {', '.join(different)}")
