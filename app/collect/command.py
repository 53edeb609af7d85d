"""``nodeslam collect``: run the expert in many cells, and store its episodes as a LeRobot data set.

Each finished episode is a line of ``episodes.jsonl`` and a folder ``episodes/<seed>``; when all are there,
they are joined. Workers return the content of files, so that they need no file system in common.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import fields
from functools import cache, partial
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from app.collect.card import OF_THE_RUN, card
from app.collect.lerobot import DatasetConfig, aggregate, assemble, check_part, n_assembled, remove_parts
from app.collect.recording import record
from app.environments.actions import codec_of
from app.environments.environment import CAMERAS, CellEnv, PackEnv, SortEnv
from app.environments.expert import Expert
from app.environments.registration import RATE
from app.errors import UsageError
from app.evaluation.ledger import Ledger, LedgerFormat, Line
from app.evaluation.statistics import wilson_interval
from app.jobs import Failure, Jobs, networks_on, run_jobs
from app.options import NOT_SETTINGS, CellOptions, CollectOptions, Task
from app.runs.manifest import CARD_FILE, is_own_card
from app.runs.report import Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from app.task.cell import robot_of
from manipulation.kinematics import Kinematics
from perception.io.files import write_atomically

Count = Annotated[int, Meta(ge=0)]
INSTRUCTIONS: dict[Task, str] = {
    "pack": "Pack all objects on the table into the box: nest the bowls and line up the mugs.",
    "sort": "Sort all objects on the table by size along the line, the smallest first.",
}


def run(options: CollectOptions, screen: Screen) -> Report:
    """Run the episodes that are not finished yet, then write the data set."""
    begin = time.perf_counter()
    if options.fault != "none":
        raise UsageError("collect: --fault is an option of pack, sort and evaluate tasks")
    config = config_of(options)
    format = LedgerFormat("collect", "episodes.jsonl", "seed", partial(check_line, options))
    ledger, finished = Ledger.open(options, format, _settings(options))
    folder, seeds = ledger.folder, range(options.seed, options.seed + options.episodes)
    to_run = [seed for seed in seeds if seed not in finished]
    assembled = n_assembled(folder.path)
    if assembled is not None and (to_run or assembled != len(_kept(options, finished.values()))):
        raise UsageError(f"--resume: the data set {folder.path} is complete; give another --out")
    jobs = Jobs(to_run, partial(collect_seed, options), partial(failed_seed, options))
    with screen.stage(f"{len(to_run)} episodes of {options.task}"):
        for line in run_jobs(jobs, options):
            _store(folder, line)
            finished[line["seed"]] = line
            ledger.append(line)
            done = [finished[seed] for seed in seeds if seed in finished]
            folder.write_report(_report(options, done, [], time.perf_counter() - begin))
            screen.note(f"seed {line['seed']}: {line['reason']}")
            screen.update(f"{len(done)} of {len(seeds)}")
    lines = [finished[seed] for seed in seeds]
    kept = _kept(options, lines)
    if kept:
        with screen.stage("Writing the data set"):
            if assembled is None:
                assemble(folder.path, kept, config)
            _write_card(folder.path / CARD_FILE, card(options, config, lines, kept), screen)
    report = _report(options, lines, kept, time.perf_counter() - begin)
    folder.write_report(report)
    remove_parts(folder.path)
    screen.show(report.reason)
    return report


class _FinishedLine(msgspec.Struct):
    """What the data set and the report need of a line of the ledger."""

    seed: Count
    success: bool
    reason: str
    n_frames: Count
    bytes: Count
    wall_seconds: Annotated[float, Meta(ge=0)]
    stats: dict[str, dict[str, list]] = msgspec.field(default_factory=dict)


def check_line(options: CollectOptions, line: Line) -> None:
    """Raise ValueError for a line that is malformed, or whose episode is not on disk.

    A complete data set needs the files of its episodes no more.
    """
    finished = msgspec.convert(line, _FinishedLine)
    assert options.out is not None  # as --resume requires
    if not finished.n_frames or n_assembled(options.out) is not None:
        return
    check_part(options.out, finished.seed, finished.n_frames, () if options.no_images else tuple(CAMERAS))
    aggregate([finished.stats])


def _kept(options: CollectOptions, lines: Iterable[Line]) -> list[Line]:
    """Return the lines of the episodes that the data set contains."""
    return [line for line in lines if line["n_frames"] and (line["success"] or options.filter == "all")]


def _write_card(path: Path, text: str, screen: Screen) -> None:
    """Write the card of the data set, unless a person's file has its name."""
    if path.exists() and not is_own_card(path):
        screen.note(f"{path} is kept; the data set has no card")
    else:
        write_atomically(path, text)


def _settings(options: CollectOptions) -> dict[str, str]:
    """Return the options that a resumed run must share: all that an episode depends on."""
    names = sorted({field.name for field in fields(CollectOptions)} - NOT_SETTINGS - OF_THE_RUN)
    return {name: str(getattr(options, name)) for name in names}


def config_of(options: CollectOptions) -> DatasetConfig:
    """Return what all episodes have in common.

    Raises:
        UsageError: ``--image-size`` is invalid.
    """
    robot = robot_of(options).description
    codec = codec_of(options.control, Kinematics(robot))
    joints = robot.joint_names
    return DatasetConfig(
        robot=options.robot,
        fps=round(RATE),
        instruction=INSTRUCTIONS[options.task],
        state_names=(*joints, *(f"{name}_velocity" for name in joints), "gripper_width"),
        action_names=codec.names,
        cameras=() if options.no_images else tuple(CAMERAS),
        image_size=parse_size(options.image_size),
    )


def parse_size(text: str) -> tuple[int, int]:
    """Return width and height of ``--image-size``.

    Raises:
        UsageError: The text is not two even numbers from 32 to 960.
    """
    parts = text.split(",")
    if len(parts) == 2 and all(part.strip().isascii() and part.strip().isdigit() for part in parts):
        width, height = (int(part) for part in parts)
        if all(32 <= side <= 960 and side % 2 == 0 for side in (width, height)):
            return width, height
    raise UsageError(f"--image-size {text[:40]} must be two even numbers from 32 to 960, such as 224,224")


def collect_seed(options: CollectOptions, seed: int) -> Line:
    """Record one episode; return its line with the content of its files."""
    begin = time.perf_counter()
    env = _environment(options)
    expert = Expert(env, networks_on(options.device), options.shapes, options.scan_views)
    try:
        episode = record(env, expert, seed)
    finally:
        expert.close()
        env.close()
    reason = f"{episode.placed} of {episode.n_objects} objects in place"
    return {
        "seed": seed,
        "success": episode.success,
        "reason": f"{reason}; {episode.failure}" if episode.failure else reason,
        "n_frames": episode.n_frames,
        "placed": episode.placed,
        "n_objects": episode.n_objects,
        "bytes": sum(len(content) for content in episode.files.values()),
        "wall_seconds": time.perf_counter() - begin,
        "stats": episode.stats,
        "files": episode.files,
    }


def failed_seed(options: CollectOptions, seed: int, failure: Failure) -> Line:
    """Return the line of an episode that could not be run to its end."""
    return {"seed": seed, "success": False, "reason": failure.reason, "n_frames": 0,
            "placed": 0, "n_objects": 0, "bytes": 0, "wall_seconds": failure.seconds}  # fmt: skip


@cache
def _environment(options: CollectOptions) -> CellEnv:
    """Return the environment, one in each process."""
    cell = {field.name: getattr(options, field.name) for field in fields(CellOptions)}
    kind = PackEnv if options.task == "pack" else SortEnv
    images, size = not options.no_images, parse_size(options.image_size)
    return kind(control=options.control, images=images, image_size=size, **cell)


def _store(folder: RunFolder, line: Line) -> None:
    """Write the files of an episode, and take them out of its line."""
    for name, content in line.pop("files", {}).items():
        write_atomically(folder.path / "episodes" / str(line["seed"]) / name, content)


def _report(options: CollectOptions, lines: Sequence[Line], kept: Sequence[Line], seconds: float) -> Report:
    n_success = sum(bool(line["success"]) for line in lines)
    failed = sum(not line["n_frames"] for line in lines)
    reason = f"{len(lines)} of {options.episodes} episodes, {n_success} successful, {len(kept)} in the set"
    return Report(
        command="collect",
        seed=options.seed,
        success=len(lines) == options.episodes and bool(kept) and not failed,
        reason=reason + (f", {failed} not run to their end" if failed else ""),
        timings={"total": seconds},
        metrics={
            "n_episodes": len(lines),
            "n_kept": len(kept),
            "success_rate": n_success / max(len(lines), 1),
            "success_rate_ci": wilson_interval(n_success, len(lines)),
            "bytes_per_episode": sum(line["bytes"] for line in lines) / max(len(lines), 1),
            "rows": [
                {key: line[key] for key in ("seed", "success", "reason", "n_frames", "bytes", "wall_seconds")}
                for line in lines
            ],
        },
        settings=_settings(options) | {"filter": options.filter},
    )
