"""Which files of a run folder this program wrote: names, sizes, and the state of the run.

Only these files are ever replaced. A name that no command writes never belongs to a run, whatever its folder.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from perception.errors import InvalidInputError
from perception.io.files import MAX_JSON_BYTES, MAX_TEXT_BYTES, parse_json, read_bytes, write_json

MANIFEST_FILE = "nodeslam_manifest.json"
FORMAT = 1
# The card of a data set has a name that people use as well: only one with this text is of a run.
CARD_FILE = "README.md"
CARD_MARK = "Episodes of the packing and sorting pipeline of NodeSLAM"
# running: not finished, or killed. replacing: its files are being moved to the folder of the replaced run.
# restoring: they are being moved back.
State = Literal["running", "complete", "replacing", "restoring"]

_CLASS = "(?:mug|bowl|bottle|can)"
_SCAN = r"(?:(?:rgb|depth)/\d{6,}\.png|scene_camera\.json|detections\.json)"
_MODEL = rf"{_CLASS}_\d+"
_OWN_NAMES = re.compile(
    "|".join(
        (
            r"(?:report|objects|plan|keyframes|evaluation|benchmark|history|shapes)\.json",
            r"(?:rows|short|episodes)\.jsonl",
            r"replay\.(?:npz|json|glb|rrd)",
            r"video\.(?:mp4|webp)",
            r"scene\.(?:glb|xml)",
            r"trajectory\.txt",
            r"bop\.csv",
            r"error\.log",
            rf"(?:overview|convergence|detections|robot|objects_{_CLASS})\.png",
            r"robot\.toml",
            rf"scan/{_SCAN}",
            rf"objects/\d+_{_CLASS}\.ply",
            r"pictures/[\w-]+\.png",
            rf"meshes/{_MODEL}(?:_\w+)?\.obj",
            rf"urdf/(?:scene|{_MODEL})\.urdf",
            rf"urdf/meshes/{_MODEL}(?:_\w+)?\.obj",
            rf"sequences/\w+/{_SCAN}",
            r"sequences/\w+/ground_truth/(?:objects\.json|trajectory\.txt|objects/\w+\.ply)",
            # data sets
            re.escape(CARD_FILE),
            r"episodes/\d+/(?:frames\.parquet|objects\.parquet|(?:wrist|scene)\.mp4)",
            r"meta/(?:info\.json|stats\.json|tasks\.parquet|episodes/chunk-\d+/file-\d+\.parquet)",
            r"(?:data|privileged)/chunk-\d+/file-\d+\.parquet",
            r"videos/observation\.images\.\w+/chunk-\d+/file-\d+\.mp4",
            # training
            r"(?:shape|detector|scene|yaw|pose|axis|verifier)\.(?:safetensors|md)",
            r"acceptance\.(?:json|md)",
            r"shape_(?:reconstructions|walk|pixel_derivative|code_derivatives)\.png",
            r"(?:train|test)_shapes\.npz",
            r"(?:second/)?(?:member\d+/)?checkpoint(?:_\w+)?\.pt",
            r"(?:scenes|pose_scenes|axis_scenes|train_shapes|test_shapes)/\w+\.npz",
            r"fits/\w+\.json",
            r"(?:second/)?(?:member\d+/)?mapped/\w+/\w+\.npy",
            r"(?:second/)?events\.out\.tfevents\.[\w.-]+",
        )
    )
)
_OWN_FOLDERS = re.compile(
    r"scan|scan/(?:rgb|depth)|objects|pictures|meshes|urdf|urdf/meshes|scenes|second|(?:second/)?member\d+"
    r"|pose_scenes|axis_scenes|train_shapes|test_shapes|fits|(?:second/)?(?:member\d+/)?mapped(?:/\w+)?"
    r"|episodes|episodes/\d+|meta|meta/episodes|(?:meta/episodes|data|privileged)/chunk-\d+|data|privileged"
    r"|videos|videos/[\w.]+|videos/[\w.]+/chunk-\d+"
    r"|sequences|sequences/\w+|sequences/\w+/(?:rgb|depth|ground_truth|ground_truth/objects)"
)
# Unfinished files of write_atomically, MovieFile and the training jobs.
_TEMPORARY = re.compile(r"\.(?P<name>.+)\.[a-z0-9_]{8}|\.video(?:\.mp4)?\.partial\.(?:mp4|webp)")
_TEMPORARY_ARRAYS = re.compile(r"\w+\.(?:partial|tmp)\.npz")
_REPORT_TYPES = {
    "command": str, "seed": int, "version": str, "success": bool, "reason": str,
    "timings": dict, "objects": list, "metrics": dict,
}  # fmt: skip


@dataclass(frozen=True)
class Manifest:
    """Content of the manifest.

    Attributes:
        command: Command of the run.
        state: State of the run.
        files: Size in bytes of each file, by its name relative to the folder; None if it is not recorded.
    """

    command: str
    state: State
    files: Mapping[str, int | None]

    def write(self, folder: Path) -> None:
        """Replace the manifest of a folder atomically."""
        content = {"nodeslam_manifest": FORMAT, "command": self.command, "state": self.state}
        write_json(folder / MANIFEST_FILE, content | {"files": dict(sorted(self.files.items()))})

    def owns(self, folder: Path, name: str) -> bool:
        """Return whether the file is the one that the run wrote."""
        status = (folder / name).lstat()
        if not stat.S_ISREG(status.st_mode):
            return False
        if self.state == "running":  # killed: names are known, sizes are not
            return True
        return name in self.files and self.files[name] in (None, status.st_size)


def read_manifest(folder: Path) -> Manifest | None:
    """Read the manifest of a run folder, or infer it for a run of a version without manifests.

    Returns None if the folder is not one of this program.
    """
    try:
        content = parse_json(read_bytes(folder / MANIFEST_FILE, MAX_JSON_BYTES))
        if content["nodeslam_manifest"] != FORMAT or content["state"] not in get_args(State):
            return None
        files = {
            str(name): int(size) for name, size in content["files"].items() if _OWN_NAMES.fullmatch(name)
        }
        return Manifest(str(content["command"]), content["state"], files)
    except FileNotFoundError:
        command = _command_of_report(folder / "report.json")
        return None if command is None else Manifest(command, "complete", dict.fromkeys(own_files(folder)))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def own_files(folder: Path) -> dict[str, int]:
    """Return the sizes of the files in a folder that have a name of this program; links are not followed."""
    found = {name: (folder / name).lstat() for name in own_names(folder)}
    return {name: status.st_size for name, status in found.items() if stat.S_ISREG(status.st_mode)}


def own_names(folder: Path) -> list[str]:
    """Return the names of everything in a folder, files or not, that is in the place of a file of a run."""
    return [
        name
        for name in _walk(folder)
        if _OWN_NAMES.fullmatch(name) and (name != CARD_FILE or is_own_card(folder / name))
    ]


def is_own_card(path: Path) -> bool:
    """Return whether a file is the card of a data set that this program wrote."""
    try:
        return CARD_MARK.encode() in read_bytes(path, MAX_TEXT_BYTES)
    except (OSError, InvalidInputError):
        return False


def temporary_files(folder: Path) -> list[Path]:
    """Return the temporary files that a killed run left in the folder."""
    return [folder / name for name in _walk(folder) if _is_temporary(name)]


def is_own_folder(name: str) -> bool:
    """Return whether runs create a folder of that relative name."""
    return _OWN_FOLDERS.fullmatch(name) is not None


def linked_folder(folder: Path) -> Path | None:
    """Return a symbolic link in the place of the folder or of one that runs create in it; None if none is."""
    if folder.is_symlink() and folder.name.startswith("."):
        return folder
    links = (folder / name for name in _walk(folder) if is_own_folder(name))
    return next((path for path in links if path.is_symlink()), None)


def _walk(folder: Path) -> Iterator[str]:
    """Yield the relative names of all files, and of all links; folders that begin with a dot are left out."""
    for place, subfolders, names in os.walk(folder):
        links = [name for name in subfolders if os.path.islink(os.path.join(place, name))]
        subfolders[:] = [name for name in subfolders if not name.startswith(".")]
        for name in (*names, *links):
            yield os.path.relpath(os.path.join(place, name), folder)


def _is_temporary(name: str) -> bool:
    parent, _, last = name.rpartition("/")
    if _TEMPORARY_ARRAYS.fullmatch(last):
        return bool(_OWN_NAMES.fullmatch(name.replace(".partial.", ".").replace(".tmp.", ".")))
    match = _TEMPORARY.fullmatch(last)
    if match is None:
        return False
    final = match["name"]
    if final is None or (final == MANIFEST_FILE and not parent):
        return not parent
    return bool(_OWN_NAMES.fullmatch(f"{parent}/{final}" if parent else final))


def _command_of_report(path: Path) -> str | None:
    """Return the command of a ``report.json`` of this program; None for anything else."""
    try:
        report: Any = parse_json(read_bytes(path, MAX_JSON_BYTES))
    except (OSError, ValueError):
        return None
    if not isinstance(report, dict):
        return None
    ours = all(isinstance(report.get(key), kind) for key, kind in _REPORT_TYPES.items())
    return report["command"] if ours else None
