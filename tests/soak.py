"""Soak tests: many runs in one process, whose memory, descriptors and files must not grow.

    python -m tests.soak episodes --out runs/soak [--runs 1000]
    python -m tests.soak slam --out runs/soak_slam [--runs 10000]

An episode packs or sorts two objects, with the whole perception and two images; its run folder replaces that
of the episode before. SLAM tracks a camera that goes back and forth along one trajectory. After each episode,
and after every hundredth frame, one line with the state of the process is appended to ``soak.jsonl`` in the
output folder. The same command line continues interrupted episodes; growth is judged within each process.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain, cycle, groupby, islice
from pathlib import Path
from statistics import median
from typing import Any

WARM_UP = 10  # lines of a process after which nothing may grow
FRAMES_PER_LINE = 100
LARGEST_GROWTH = 0.05  # of the resident memory
AT_THE_ENDS = 20  # lines whose median is the memory at the beginning and at the end
Line = dict[str, Any]


def state(temporary: Path) -> Line:
    """Return resident memory [B], open descriptors and threads of this process, and its temporary files."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return {
        "resident": pages * os.sysconf("SC_PAGE_SIZE"),
        "descriptors": len(os.listdir("/proc/self/fd")),
        "threads": len(os.listdir("/proc/self/task")),
        "temporary_files": count_files(temporary),
    }


def count_files(folder: Path) -> int:
    return sum(len(files) for _, _, files in os.walk(folder))


def episodes(out: Path, first: int, last: int) -> Iterator[Line]:
    """Run the episodes of the seeds in [first, last) in cells of their own."""
    from app.memory import release_freed_memory
    from app.options import PackOptions, SortOptions
    from app.screen import Screen
    from app.task.cell import build_world
    from app.task.recording import CellRecorder
    from app.task.run import run_and_store, task_of
    from app.task.run_control import RunControl
    from app.task.run_writer import RunSession
    from perception.pipeline import load_perception

    perception, screen = load_perception("auto"), Screen(quiet=True)
    for seed in range(first, last):
        kind = (PackOptions, SortOptions)[seed % 2]
        options = kind(objects="2", scan_views=2, seed=seed, quiet=True, out=out / "run")
        line: Line = {"number": seed, "task": task_of(options)}
        try:
            with build_world(options, task_of(options)) as world:
                session = RunSession(world, CellRecorder(world), RunControl(), screen)
                report = run_and_store(options, perception, session)
            line |= {"success": report.success, "reason": report.reason}
        except Exception:
            line |= {"success": False, "crash": traceback.format_exc()}
        release_freed_memory()
        yield line | {"run_files": count_files(out / "run")}


def slam(out: Path, first: int, last: int) -> Iterator[Line]:
    """Track a camera over the frames in [first, last), which lead back and forth along a trajectory."""
    from nodeslam import Slam
    from sim_assets.datasets.sequences import RATE, SequenceConfig, TableSequence

    images = [image.frame for image in TableSequence(0, SequenceConfig(frames=300)).render()]
    endless = cycle(chain(images, reversed(images)))
    system = Slam.load()
    lost = 0
    for number, image in enumerate(islice(endless, last)):
        pose = image.T_world_camera if number == 0 else None
        result = system.process(replace(image, time=number / RATE, T_world_camera=pose))
        lost += result.status == "lost"
        if (number + 1) % FRAMES_PER_LINE == 0:
            landmarks = len(system.world.landmarks) if system.world else 0
            yield {"number": number, "lost": lost, "landmarks": landmarks, "keyframes": len(system.keyframes)}


def growth(values: list[int]) -> tuple[float, float]:
    """Return the medians after the warm-up and at the end; twice the first value for a few values."""
    after = values[WARM_UP:]
    if len(after) < 2 * AT_THE_ENDS:
        return values[0], values[0]
    return median(after[:AT_THE_ENDS]), median(after[-AT_THE_ENDS:])


def problems(lines: list[Line]) -> list[str]:
    """Return what is wrong in the lines of a soak test: crashes, and what grew within one process."""
    found = [f"run {line['number']}: {line['crash'].splitlines()[-1]}" for line in lines if "crash" in line]
    for process, group in groupby(lines, key=lambda line: line["process"]):
        same = list(group)
        for name in JUDGED:
            before, after = growth([line[name] for line in same])
            if after > before * (1 + LARGEST_GROWTH * (name == "resident")):
                found.append(f"process {process}, {len(same)} lines: {name} grew from {before} to {after}")
    return found


JUDGED = ("resident", "descriptors", "temporary_files")  # pools start threads as they need them
RUNS: dict[str, tuple[Callable[[Path, int, int], Iterator[Line]], int]] = {
    "episodes": (episodes, 1000),
    "slam": (slam, 10000),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=RUNS)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--runs", type=int)
    options = parser.parse_args()
    run, runs = RUNS[options.what]
    ledger, temporary = options.out / "soak.jsonl", options.out / "tmp"
    temporary.mkdir(parents=True, exist_ok=True)
    os.environ["TMPDIR"] = str(temporary.resolve())
    lines = [json.loads(line) for line in ledger.read_text().splitlines()] if ledger.exists() else []
    begin, process = time.perf_counter(), os.getpid()
    first = len(lines) if options.what == "episodes" else 0
    for line in run(options.out, first, options.runs or runs):
        seconds = round(time.perf_counter() - begin, 1)
        lines.append({"process": process, "seconds": seconds, **line, **state(temporary)})
        with ledger.open("a") as file:
            file.write(json.dumps(lines[-1]) + "\n")
    wrong = problems(lines)
    summary = {name: (lines[WARM_UP][name], lines[-1][name]) for name in JUDGED}
    sys.stdout.write(f"{len(lines)} lines, from the tenth to the last: {summary}\n" + "\n".join(wrong) + "\n")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
