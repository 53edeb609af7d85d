"""Folder of a run, written in stages so that an interrupted process leaves readable results."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from app.errors import UsageError
from app.options import CommonOptions
from app.runs.report import Report
from perception.io.files import write_json

_OWN_FILES = (
    "report.json", "objects.json", "plan.json", "replay.npz", "replay.json", "replay.glb",
    "overview.png", "video.mp4", "scene.glb", "scene.xml",
)  # fmt: skip
_OWN_FOLDERS = ("scan", "objects", "meshes", "urdf", "pictures")


@dataclass(frozen=True)
class RunFolder:
    """Paths of the files of a run.

    Attributes:
        path: The folder.
    """

    path: Path

    @staticmethod
    def create(options: CommonOptions, command: str) -> RunFolder:
        """Create the folder of ``--out``, or replace a run that is stored there.

        Raises:
            UsageError: The path exists and is not a run folder, or cannot be written.
        """
        stamp = time.strftime("%Y%m%d-%H%M%S")
        path = options.out or Path("runs") / f"{stamp}_{command}_seed{options.seed}"
        try:
            if path.exists() and not path.is_dir():
                raise UsageError(f"--out {path} is a file: give a folder")
            if path.is_dir() and any(path.iterdir()):
                _clear(path)
            path.mkdir(parents=True, exist_ok=True)
            folder = RunFolder(path)
            folder.write_report(
                Report(command, options.seed, reason="stopped before the first stage was done")
            )
        except OSError as error:
            raise UsageError(
                f"--out {path} cannot be written ({error.strerror}): give another folder"
            ) from None
        return folder

    def write_report(self, report: Report) -> None:
        """Replace ``report.json`` atomically."""
        write_json(self.path / "report.json", report.as_json())

    def write_json(self, name: str, value: Any) -> None:
        write_json(self.path / name, value)

    @property
    def scan(self) -> Path:
        return self.path / "scan"


def _clear(path: Path) -> None:
    """Remove the files of a stored run, and nothing else."""
    if not (path / "report.json").is_file():
        raise UsageError(f"--out {path} is not empty and no run folder: give another folder")
    for name in _OWN_FILES:
        (path / name).unlink(missing_ok=True)
    for name in _OWN_FOLDERS:
        if (path / name).is_dir() and not (path / name).is_symlink():
            shutil.rmtree(path / name)
