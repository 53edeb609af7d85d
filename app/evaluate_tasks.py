"""``nodeslam evaluate tasks``: success over many episodes, with its interval and the reasons of failures.

Each finished episode is one line of ``episodes.jsonl``, appended at once: an interrupted evaluation goes on
with ``--resume`` where it stopped. Episodes run in processes of one thread each, here or on a Ray cluster.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from app.errors import MissingExtraError, UsageError
from app.options import EvaluateOptions
from app.report import Report
from app.run_folder import RunFolder
from app.screen import Screen
from app.statistics import summarise
from app.tables import evaluation_table
from perception.files import read_json, write_json

THREAD_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
EPISODES = "episodes.jsonl"
SETTINGS = "evaluation.json"


def run(options: EvaluateOptions, screen: Screen) -> Report:
    """Run the episodes that are still to be run, and report on all."""
    begin = time.perf_counter()
    folder, finished = _open(options)
    seeds = range(options.seed, options.seed + options.episodes)
    to_run = [seed for seed in seeds if seed not in finished]
    if finished:
        screen.note(f"{len(seeds) - len(to_run)} of {len(seeds)} episodes are finished already")
    with screen.stage(f"{len(to_run)} episodes of {options.task}"):
        for line in _lines(options, to_run):
            finished[line["seed"]] = line
            _append(folder.path / EPISODES, line)
            done = [finished[seed] for seed in seeds if seed in finished]
            folder.write_report(_report(options, done, time.perf_counter() - begin))
            screen.note(f"seed {line['seed']}: {line['reason']}")
            screen.update(f"{len(done)} of {len(seeds)}")
    report = _report(options, [finished[seed] for seed in seeds], time.perf_counter() - begin)
    folder.write_report(report)
    screen.show(evaluation_table(report))
    return report


def run_seed(options: EvaluateOptions, seed: int) -> dict[str, Any]:
    """One episode, as a line of the results; what breaks is its reason, not the end of the evaluation."""
    from app.cell import build_world
    from app.episode import run_episode

    begin = time.perf_counter()
    episode = replace(options, seed=seed)
    line: dict[str, Any] = {"seed": seed, "task": options.task}
    try:
        with build_world(episode, options.task) as world:
            report, _ = run_episode(world, episode, options.task, _perception(options.device))
            line |= {
                key: report.as_json()[key] for key in ("success", "reason", "timings", "objects", "metrics")
            }
    except (UsageError, MissingExtraError):
        raise
    except Exception as error:  # a crash of one episode is a result, too
        line |= {"success": False, "reason": f"crashed: {type(error).__name__}: {error}", "objects": []}
    return line | {"wall_seconds": time.perf_counter() - begin}


@cache
def _perception(device: Any) -> Any:
    """Networks, loaded once in each process."""
    from app.perceive import load_perception

    return load_perception(device)


def _lines(options: EvaluateOptions, seeds: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Results in the order in which they come."""
    if options.ray is not None:
        yield from _on_ray(options, seeds)
    elif options.workers == 1:
        yield from (run_seed(options, seed) for seed in seeds)
    else:
        yield from _in_processes(options, seeds)


def _in_processes(options: EvaluateOptions, seeds: Sequence[int]) -> Iterator[dict[str, Any]]:
    os.environ.update(dict.fromkeys(THREAD_POOLS, "1"))  # inherited: pools of several processes fight
    context = multiprocessing.get_context("spawn")  # a GL context does not survive a fork
    with ProcessPoolExecutor(options.workers, mp_context=context, initializer=_single_threaded) as pool:
        jobs = [pool.submit(run_seed, options, seed) for seed in seeds]
        try:
            for job in as_completed(jobs):
                yield job.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _single_threaded() -> None:
    import torch

    torch.set_num_threads(1)


def _on_ray(options: EvaluateOptions, seeds: Sequence[int]) -> Iterator[dict[str, Any]]:
    try:
        import ray
    except ImportError:
        raise MissingExtraError("--ray needs Ray: pip install 'nodeslam[cluster]'") from None
    ray.init(address=options.ray, log_to_driver=False)
    waiting = [ray.remote(num_cpus=1)(run_seed).remote(options, seed) for seed in seeds]
    try:
        while waiting:
            finished, waiting = ray.wait(waiting)
            yield from ray.get(finished)
    finally:
        ray.shutdown()


def _open(options: EvaluateOptions) -> tuple[RunFolder, dict[int, dict[str, Any]]]:
    """The folder and the episodes in it that are finished, by seed; fresh and none without ``--resume``."""
    wanted = _settings(options)
    if not options.resume:
        folder = RunFolder.create(options, "evaluate-tasks")
        (folder.path / EPISODES).unlink(missing_ok=True)
        write_json(folder.path / SETTINGS, wanted)
        return folder, {}
    if options.out is None:
        raise UsageError("--resume needs --out with the folder to go on in")
    kept = read_json(options.out / SETTINGS, "give the --out of the evaluation to be resumed")
    different = sorted(key for key in wanted if not isinstance(kept, dict) or kept.get(key) != wanted[key])
    if different:
        raise UsageError(f"--resume: {options.out} was made with another {', '.join(different)}")
    return RunFolder(options.out), read_episodes(options.out / EPISODES)


def _settings(options: EvaluateOptions) -> dict[str, Any]:
    """What has to be the same in a resumed evaluation."""
    names = ("task", "objects", "object_meshes", "box", "depth_noise", "shapes", "device")
    return {name: str(getattr(options, name)) for name in names}


def _append(path: Path, line: Mapping[str, Any]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")
        file.flush()
        os.fsync(file.fileno())


def read_episodes(path: Path) -> dict[int, dict[str, Any]]:
    """Finished episodes by seed; a last line cut short by an interruption is run again."""
    episodes: dict[int, dict[str, Any]] = {}
    if not path.exists():
        return episodes
    whole = []
    for text in path.read_text(encoding="utf-8").splitlines():
        try:
            line = json.loads(text)
            episodes[int(line["seed"])] = line
            whole.append(text)
        except (ValueError, KeyError, TypeError):
            continue
    path.write_text("".join(text + "\n" for text in whole), encoding="utf-8")
    return episodes


def _report(options: EvaluateOptions, lines: Sequence[Mapping[str, Any]], seconds: float) -> Report:
    metrics = summarise(lines)
    done = len(lines) == options.episodes
    return Report(
        command="evaluate tasks",
        seed=options.seed,
        success=done,
        reason=f"{len(lines)} of {options.episodes} episodes, {metrics['n_successes']} of them complete",
        timings={"total": seconds},
        metrics=metrics,
        settings=_settings(options),
    )
