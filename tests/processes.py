"""Commands in processes of their own, and what is left of them, for tests of faults and of endurance."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from app.runs.manifest import MANIFEST_FILE
from app.runs.run_folder import PREVIOUS

ROOT = Path(__file__).parents[1]
NOTES = (MANIFEST_FILE, f".{MANIFEST_FILE}", ".nodeslam.lock")
LONGEST = 1800  # [s] of one command


def command_line(arguments: tuple[str, ...], out: Path) -> list[str]:
    return [sys.executable, "-m", "app", *arguments, "--out", str(out), "--quiet"]


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}


def run(arguments: tuple[str, ...], out: Path) -> float:
    """Run a command to its end; return its duration in [s].

    Raises:
        RuntimeError: It ended with another code than 0 or 1.
    """
    begin = time.perf_counter()
    done = subprocess.run(
        command_line(arguments, out), env=environment(), capture_output=True, text=True, timeout=LONGEST
    )
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(arguments)} ended with {done.returncode}: {done.stderr.strip()}")
    return time.perf_counter() - begin


def contents(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder but for the program's notes about them."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(NOTES)
    }


def processes_of(group: int) -> list[str]:
    """Return the ids of the processes of a group that are still alive."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, its_group = status.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(its_group) == group and state != "Z":
            found.append(status.parent.name)
    return found


def lost_files(out: Path, old: dict[str, bytes], complete: bool) -> list[str]:
    """Return the files of the earlier run that are nowhere, although no complete run replaced them.

    Args:
        out: Folder of the earlier run, in which a command was killed.
        old: What was in it.
        complete: Whether the command ended by itself.

    Raises:
        ValueError: A JSON file is not whole, or a person's file has changed.
    """
    for path in out.rglob("*.json"):
        json.loads(path.read_text())
    now = contents(out)
    if now.get("notes.txt") != old.get("notes.txt"):
        raise ValueError("notes.txt has changed")
    if complete or not old or json.loads((out / MANIFEST_FILE).read_text())["state"] == "complete":
        return []
    return [name for name in old if old[name] not in (now.get(name), now.get(f"{PREVIOUS}/{name}"))]
