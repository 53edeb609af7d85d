"""Random kills of every command over folders that hold an earlier run.

    python -m tests.kills --out runs/kills --kills 200 [--first 200] [--only pack sort]

Each kill starts a command in a copy of a folder with a finished run and a person's file, sends SIGINT,
SIGTERM or SIGKILL at a random moment, and requires that

- at most one line was printed, and no process is left;
- every file that was there is in place, in ``.previous``, or replaced by a complete run; all JSON is whole;
- where the command can resume, resuming gives the result of an uninterrupted run;
- otherwise, every twentieth time, the command run again gives the same result.

Trainings start in an empty folder, as one with a finished training has nothing left to interrupt.

Results are appended to ``kills.jsonl`` in the output folder; the same command line continues an interrupted
campaign.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import trimesh

from app.runs.manifest import own_names
from tests.processes import LONGEST, command_line, contents, environment, lost_files, processes_of, run

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
PERSONS_FILE = "notes.txt"
_INTERPRETER_STARTS = "Failed to import the site module"
GRACE = 3.0  # [s] in which the workers of a killed command end, on a machine that is busy
REPEATED_EVERY = 20  # kills, for commands without --resume
# Entries of a report that differ between two runs of one command.
UNREPEATABLE = {"timings", "wall_seconds", "seconds", "settings", "stage_seconds", "joint_seconds",
                "tracking_rate", "loop_rate"}  # fmt: skip
# Files that do not differ.
REPEATABLE_FILES = {".parquet", ".safetensors", ".ply", ".obj", ".xml", ".urdf"}


@dataclass(frozen=True)
class Command:
    """A command to be killed.

    Attributes:
        arguments: Command line without ``--out``.
        resume: Options that continue it; None if it cannot be continued.
        fresh: Whether it starts in an empty folder, not in that of an earlier run.
    """

    arguments: tuple[str, ...]
    resume: tuple[str, ...] | None = None
    fresh: bool = False


def commands(inputs: Path) -> dict[str, Command]:
    """Return the commands by name; they read the runs in the folder of inputs."""
    run, map_, meshes = str(inputs / "scan"), str(inputs / "map"), str(inputs / "meshes")
    scan, can, seed = f"{run}/scan", ("--objects", "can=1"), ("--seed", "4")
    short = (*can, *seed, "--scan-views", "2", "--shapes", "oracle")
    tasks = ("evaluate", "tasks", "--episodes", "2", *short)
    train = ("train", "shape", "--epochs", "2", "--meshes", meshes)
    return {
        "doctor": Command(("doctor",)),
        "glb": Command(("export", map_)),
        "mjcf": Command(("export", map_, "--format", "mjcf")),
        "urdf": Command(("export", map_, "--format", "urdf")),
        "scan": Command(("scan", *can, *seed)),
        "reconstruct": Command(("reconstruct", scan)),
        "ar": Command(("ar", map_, "--drops", "1", "--seconds", "0.2")),
        "slam": Command(("slam", scan)),
        "convert": Command(("convert", str(inputs / "recording"), "--camera", "525,525,319.5,239.5")),
        "pack": Command(("pack", *short)),
        "sort": Command(("sort", *short)),
        "bench": Command(("bench", "--scan", scan, "--repeats", "1")),
        "tasks": Command(tasks, resume=("--resume",)),
        "workers": Command((*tasks, "--workers", "2"), resume=("--resume",)),
        "collect": Command(("collect", "--episodes", "2", "--no-images", *short), resume=("--resume",)),
        "train": Command(train, resume=(), fresh=True),
    }


def make_inputs(folder: Path) -> None:
    """Make the runs that the commands read: a scan, its object map, a recording, and meshes to train on."""
    if (folder / "complete").exists():
        return
    run(("scan", "--objects", "can=1", "--seed", "3"), folder / "scan")
    run(("reconstruct", str(folder / "scan" / "scan")), folder / "map")
    for kind in ("rgb", "depth"):
        shutil.copytree(folder / "scan" / "scan" / kind, folder / "recording" / kind, dirs_exist_ok=True)
    for index, radius in enumerate((0.03, 0.035, 0.04, 0.045)):
        path = folder / "meshes" / "can" / f"{index}.obj"
        path.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.cylinder(radius, 0.1, sections=24).export(path)
    (folder / "complete").touch()


def result_of(folder: Path) -> object:
    """Return the report without what differs between two runs of one command."""
    return _repeatable(json.loads((folder / "report.json").read_text().replace(str(folder), "OUT")))


def _repeatable(value: object) -> object:
    if isinstance(value, dict):
        return {key: _repeatable(entry) for key, entry in value.items() if key not in UNREPEATABLE}
    return [_repeatable(entry) for entry in value] if isinstance(value, list) else value


class Campaign:
    """Kills of the commands in one folder.

    Args:
        folder: where inputs, earlier runs and results are.
        names: commands to kill; all if None.
    """

    def __init__(self, folder: Path, names: list[str] | None = None) -> None:
        self.folder = folder
        make_inputs(folder / "inputs")
        every = commands(folder / "inputs")
        self.commands = {name: every[name] for name in names or every}
        self.seconds = {name: self._earlier_run(name) for name in self.commands}

    def _earlier_run(self, name: str) -> float:
        """Run a command to its end, once; return its duration in [s]."""
        folder, note = self.folder / "earlier" / name, self.folder / "earlier" / f"{name}.seconds"
        if not note.exists():
            shutil.rmtree(folder, ignore_errors=True)
            seconds = run(self.commands[name].arguments, folder)
            foreign = contents(folder).keys() - set(own_names(folder))
            if foreign:
                raise RuntimeError(f"{name} wrote files that its manifest does not know: {sorted(foreign)}")
            (folder / PERSONS_FILE).write_text("a person's")
            note.write_text(str(seconds))
        return float(note.read_text())

    def kill(self, number: int) -> dict[str, object]:
        """Kill a command at a moment that follows from the number; return what happened."""
        rng = random.Random(number)
        name = list(self.commands)[number % len(self.commands)]
        how, moment = rng.choice(SIGNALS), rng.uniform(0, 1.1 * self.seconds[name])
        out = self.folder / f"kill{number}"
        shutil.rmtree(out, ignore_errors=True)
        if not self.commands[name].fresh:
            shutil.copytree(self.folder / "earlier" / name, out)
        process = subprocess.Popen(
            command_line(self.commands[name].arguments, out), env=environment(),
            stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, start_new_session=True,
        )  # fmt: skip
        time.sleep(moment)
        process.send_signal(how)
        try:
            _, error = process.communicate(timeout=LONGEST)
            problem = self._problem(number, name, out, process, error)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            problem = "does not end"
        row = {"number": number, "command": name, "signal": how.name, "moment": round(moment, 2)}
        if not problem:
            shutil.rmtree(out, ignore_errors=True)
        return {**row, "code": process.returncode, "problem": problem}

    def _problem(self, number: int, name: str, out: Path, process: subprocess.Popen, error: str) -> str:
        """Return what is wrong after a kill, or an empty string."""
        if _INTERPRETER_STARTS in error:  # Python's own message, before a line of this program runs
            return ""
        if "Traceback" in error or len(error.splitlines()) > 1:
            return f"printed {error!r}"
        deadline = time.monotonic() + GRACE
        while processes_of(process.pid) and time.monotonic() < deadline:
            time.sleep(0.1)
        if processes_of(process.pid):
            return f"processes {processes_of(process.pid)} are left"
        earlier, command = self.folder / "earlier" / name, self.commands[name]
        complete = process.returncode in (0, 1)
        try:
            lost = lost_files(out, {} if command.fresh else contents(earlier), complete)
        except ValueError as reason:
            return str(reason)
        if lost:
            return f"lost {lost}"
        if command.resume is None:
            due = number // len(self.commands) % REPEATED_EVERY == 0
            return self._repeated(command.arguments, out, earlier) if due else ""
        if complete or not (command.fresh or (out / "evaluation.json").exists()):
            return ""
        return self._repeated((*command.arguments, *command.resume), out, earlier)

    def _repeated(self, arguments: tuple[str, ...], out: Path, earlier: Path) -> str:
        """Run a command again in the folder of the killed one; return how its result differs."""
        try:
            run(arguments, out)
        except (RuntimeError, subprocess.TimeoutExpired) as reason:
            return str(reason)
        found, expected = contents(out), contents(earlier)
        different = (found.keys() ^ expected.keys()) - {PERSONS_FILE}
        different |= {
            name
            for name in found.keys() & expected.keys()
            if Path(name).suffix in REPEATABLE_FILES and found[name] != expected[name]
        }
        if different:
            return f"other files: {sorted(different)}"
        if arguments[0] != "bench" and result_of(out) != result_of(earlier):
            return "another report"
        return ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="number, and seed, of the first kill")
    parser.add_argument("--only", nargs="+", default=None)
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored by processes in a shell's background
    options.out.mkdir(parents=True, exist_ok=True)
    campaign, ledger = Campaign(options.out.resolve(), options.only), options.out / "kills.jsonl"
    rows = [json.loads(line) for line in ledger.read_text().splitlines()] if ledger.exists() else []
    numbers = range(options.first, options.first + options.kills)
    for number in sorted(set(numbers) - {row["number"] for row in rows}):
        rows.append(campaign.kill(number))
        with ledger.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        if rows[-1]["problem"]:
            sys.stderr.write(f"{rows[-1]}\n")
    bad = sum(bool(row["problem"]) for row in rows)
    kinds = Counter(f"{row['command']} {row['signal']}" for row in rows)
    sys.stdout.write(f"{len(rows)} kills, {bad} with a problem; {dict(sorted(kinds.items()))}\n")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
