"""``nodeslam evaluate tasks``: success rates over many episodes, and failure reasons.

Each finished episode is one line of ``episodes.jsonl``. An episode that cannot be laid out or crashes counts
as failed. Where several sources of shapes, numbers of images or uses of uncertainty are given, all of their
combinations run the same seeds and are compared (``app.evaluation.study``).
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import asdict, fields
from functools import partial
from typing import Any

from app.evaluation.cells import Cell, cells_of, episode_options
from app.evaluation.ledger import Ledger, LedgerFormat, Line
from app.evaluation.statistics import summarise
from app.evaluation.study import compare_cells, study_svg, study_table
from app.jobs import Failure, Jobs, networks_on, run_jobs
from app.options import NOT_SETTINGS, EvaluateOptions, TaskOptions
from app.runs.report import Report
from app.screen import Screen
from app.tables import evaluation_table
from perception.io.files import write_atomically

EPISODES = "episodes.jsonl"
EPISODE = "episode"  # entry of a line that identifies it where several cells are compared


def run(options: EvaluateOptions, screen: Screen) -> Report:
    """Run the episodes that are not finished yet, and report on all."""
    begin = time.perf_counter()
    ledger, finished = Ledger.open(options, _format(options), _settings(options))
    folder = ledger.folder
    cells, seeds = cells_of(options), range(options.seed, options.seed + options.episodes)
    of_key = {_key(cells, cell, seed): (cell, seed) for cell in cells for seed in seeds}
    to_run = [item for key, item in of_key.items() if key not in finished]
    to_run.sort(key=lambda item: item[1])  # all cells on a seed: what is interrupted can be compared
    if finished:
        screen.note(f"{len(of_key) - len(to_run)} of {len(of_key)} episodes are finished already")
    jobs = Jobs(to_run, partial(_run, options, cells), partial(_failed, options, cells))
    with screen.stage(f"{len(to_run)} episodes of {options.task}"):
        for line in run_jobs(jobs, options):
            finished[line[ledger.format.key]] = line
            ledger.append(line)
            done = [finished[key] for key in of_key if key in finished]
            folder.write_report(_report(options, cells, done, time.perf_counter() - begin))
            screen.note(f"{line.get(EPISODE, 'seed ' + str(line['seed']))}: {line['reason']}")
            screen.update(f"{len(done)} of {len(of_key)}")
    report = _report(options, cells, [finished[key] for key in of_key], time.perf_counter() - begin)
    folder.write_report(report)
    screen.show(evaluation_table(report))
    if len(cells) > 1:
        write_atomically(folder.path / "study.svg", study_svg(report.metrics["cells"]))
        screen.show(study_table(report.metrics["cells"]))
    return report


def _key(cells: Sequence[Cell], cell: Cell, seed: int) -> Hashable:
    """Return the key of an episode in the ledger: its seed, or with several cells also the cell."""
    return seed if len(cells) == 1 else cell.key(seed)


def _entries(cells: Sequence[Cell], cell: Cell, seed: int) -> Line:
    """Return the entries of an episode's line that tell its cell, where there are several."""
    return {} if len(cells) == 1 else {EPISODE: cell.key(seed)} | asdict(cell)


def _run(options: EvaluateOptions, cells: Sequence[Cell], item: tuple[Cell, int]) -> Line:
    cell, seed = item
    return run_seed(cell.of(options), seed) | _entries(cells, cell, seed)


def _failed(
    options: EvaluateOptions, cells: Sequence[Cell], item: tuple[Cell, int], failure: Failure
) -> Line:
    cell, seed = item
    return failed_seed(options, seed, failure) | _entries(cells, cell, seed)


def run_seed(options: EvaluateOptions, seed: int) -> Line:
    """Run one episode of an evaluation with a single cell, and return its line of the results."""
    from app.task.cell import build_world
    from app.task.episode import run_episode

    begin = time.perf_counter()
    episode = episode_options(options, seed)
    with build_world(episode, options.task) as world:
        report, _ = run_episode(
            world, episode, options.task, networks_on(options.device), perceive_only=options.perceive_only
        )
    entries = report.as_json()
    line = {key: entries[key] for key in ("success", "reason", "timings", "objects", "metrics")}
    return {"seed": seed, "task": options.task} | line | {"wall_seconds": time.perf_counter() - begin}


def failed_seed(options: EvaluateOptions, seed: int, failure: Failure) -> Line:
    """Return the line of an episode that could not be run to its end."""
    return {
        "seed": seed,
        "task": options.task,
        "success": False,
        "reason": failure.reason,
        "objects": [],
        "wall_seconds": failure.seconds,
        "failed": True,
    }


def _format(options: EvaluateOptions) -> LedgerFormat:
    def check(line: Line) -> None:
        if line.get("task", options.task) != options.task or type(line["success"]) is not bool:
            raise ValueError(f"not an episode of {options.task}")
        if not all(isinstance(entry.get("placed"), bool | None) for entry in line["objects"]):
            raise ValueError("placed is neither true, false nor null")
        summarise([line])

    key = "seed" if len(cells_of(options)) == 1 else EPISODE
    return LedgerFormat("evaluate-tasks", EPISODES, key, check)


def _settings(options: EvaluateOptions) -> dict[str, Any]:
    """Return the options that a resumed evaluation must share."""
    names = ("task", "perceive_only", *sorted({field.name for field in fields(TaskOptions)} - NOT_SETTINGS))
    values = {name: getattr(options, name) for name in names}
    return {n: " ".join(v) if isinstance(v, tuple) else str(v) for n, v in values.items()}


def _report(
    options: EvaluateOptions, cells: Sequence[Cell], lines: Sequence[Mapping[str, Any]], seconds: float
) -> Report:
    metrics, n_episodes = summarise(lines), options.episodes * len(cells)
    if len(cells) > 1:
        metrics["cells"] = compare_cells(cells, lines)
    failed = sum("failed" in line for line in lines)
    reason = f"{len(lines)} of {n_episodes} episodes, {metrics['n_successes']} of them complete"
    return Report(
        command="evaluate tasks",
        seed=options.seed,
        success=len(lines) == n_episodes and not failed,
        reason=reason + (f", {failed} not run to their end" if failed else ""),
        timings={"total": seconds},
        metrics=metrics,
        settings=_settings(options),
    )
