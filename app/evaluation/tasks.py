"""``nodeslam evaluate tasks``: success rates over many episodes, and failure reasons.

Each finished episode is one line of ``episodes.jsonl``. An episode that cannot be laid out or crashes counts
as failed.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

from app.evaluation.ledger import Ledger, LedgerFormat, Line
from app.evaluation.statistics import summarise
from app.jobs import Failure, Jobs, networks_on, run_jobs
from app.options import NOT_SETTINGS, EvaluateOptions, TaskOptions
from app.runs.report import Report
from app.screen import Screen
from app.tables import evaluation_table

EPISODES = "episodes.jsonl"


def run(options: EvaluateOptions, screen: Screen) -> Report:
    """Run the episodes that are not finished yet, and report on all."""
    begin = time.perf_counter()
    ledger, finished = Ledger.open(options, _format(options), _settings(options))
    folder = ledger.folder
    seeds = range(options.seed, options.seed + options.episodes)
    to_run = [seed for seed in seeds if seed not in finished]
    if finished:
        screen.note(f"{len(seeds) - len(to_run)} of {len(seeds)} episodes are finished already")
    jobs = Jobs(to_run, partial(run_seed, options), partial(failed_seed, options))
    with screen.stage(f"{len(to_run)} episodes of {options.task}"):
        for line in run_jobs(jobs, options):
            finished[line["seed"]] = line
            ledger.append(line)
            done = [finished[seed] for seed in seeds if seed in finished]
            folder.write_report(_report(options, done, time.perf_counter() - begin))
            screen.note(f"seed {line['seed']}: {line['reason']}")
            screen.update(f"{len(done)} of {len(seeds)}")
    report = _report(options, [finished[seed] for seed in seeds], time.perf_counter() - begin)
    folder.write_report(report)
    screen.show(evaluation_table(report))
    return report


def run_seed(options: EvaluateOptions, seed: int) -> Line:
    """Run one episode and return its line of the results."""
    from app.task.cell import build_world
    from app.task.episode import run_episode

    begin = time.perf_counter()
    episode = replace(options, seed=seed)
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

    return LedgerFormat("evaluate-tasks", EPISODES, "seed", check)


def _settings(options: EvaluateOptions) -> dict[str, Any]:
    """Return the options that a resumed evaluation must share."""
    names = ("task", "perceive_only", *sorted({field.name for field in fields(TaskOptions)} - NOT_SETTINGS))
    return {name: str(getattr(options, name)) for name in names}


def _report(options: EvaluateOptions, lines: Sequence[Mapping[str, Any]], seconds: float) -> Report:
    metrics = summarise(lines)
    failed = sum("failed" in line for line in lines)
    reason = f"{len(lines)} of {options.episodes} episodes, {metrics['n_successes']} of them complete"
    return Report(
        command="evaluate tasks",
        seed=options.seed,
        success=len(lines) == options.episodes and not failed,
        reason=reason + (f", {failed} not run to their end" if failed else ""),
        timings={"total": seconds},
        metrics=metrics,
        settings=_settings(options),
    )
