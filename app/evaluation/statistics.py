"""Summary of many episodes: rates with confidence intervals, failure reasons with counts, medians."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest
from scipy.stats import t as student_t

RIGHT_AXIS = math.radians(30)  # largest error of the axis of a right pose
Z_95 = 1.959963984540054  # two-sided 95 % quantile of the normal distribution


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return Wilson's 95 % score interval of a success rate (E. B. Wilson, JASA 22, 1927).

    Without trials the interval is (0, 1).
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes of {trials} trials")
    if trials == 0:
        return 0.0, 1.0
    interval = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def paired_difference(
    first: Mapping[Hashable, float], second: Mapping[Hashable, float]
) -> dict[str, float | None]:
    """Return the mean of second minus first over their common keys, with Student's 95 % interval.

    Returns:
        ``mean``, ``low``, ``high`` and ``n``; the first three are None for fewer than two pairs.
    """
    differences = np.array([second[key] - first[key] for key in first if key in second])
    n = len(differences)
    if n < 2:
        return {"mean": None, "low": None, "high": None, "n": n}
    mean, error = float(differences.mean()), float(differences.std(ddof=1)) / math.sqrt(n)
    half = float(student_t.ppf(0.975, n - 1)) * error
    return {"mean": mean, "low": mean - half, "high": mean + half, "n": n}


def summarise(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return success rates with Wilson 95 % intervals, failure reasons, times and reconstruction medians."""
    objects = [entry for line in lines for entry in line["objects"]]
    n_successes, n_placed = sum(bool(line["success"]) for line in lines), _count_placed(objects)
    by_class: dict[str, list[Any]] = defaultdict(list)
    for entry in objects:
        by_class[entry["category"]].append(entry)
    return {
        "n_episodes": len(lines),
        "n_successes": n_successes,
        "success_rate": n_successes / max(len(lines), 1),
        "success_rate_ci": wilson_interval(n_successes, len(lines)),
        "n_objects": len(objects),
        "n_placed": n_placed,
        "object_success_rate": n_placed / max(len(objects), 1),
        "object_success_rate_ci": wilson_interval(n_placed, len(objects)),
        "per_class": {name: _class_rate(entries) for name, entries in sorted(by_class.items())},
        "unknown": _unknown(lines),
        "failures": _failures(lines, objects),
        "simulated_seconds": _median(line.get("metrics", {}).get("simulated_seconds") for line in lines),
        "wall_seconds": _median(line.get("wall_seconds") for line in lines),
        "stage_seconds": _stages(lines),
        "reconstruction": _reconstruction(lines),
        "resting": _resting(lines),
        "faults": _faults(lines),
        "rows": [
            {key: line.get(key) for key in ("seed", "success", "reason", "wall_seconds")} for line in lines
        ],
    }


def _count_placed(objects: Iterable[Mapping[str, Any]]) -> int:
    return sum(bool(entry["placed"]) for entry in objects)


def _class_rate(entries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    n_placed = _count_placed(entries)
    return {
        "n_objects": len(entries),
        "success_rate": n_placed / len(entries),
        "success_rate_ci": wilson_interval(n_placed, len(entries)),
    }


def _unknown(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return how many things of no class there were, were moved and toppled, and the largest shift [m]."""
    things = [thing for line in lines for thing in line.get("metrics", {}).get("unknown", ())]
    return {
        "n_things": len(things),
        "n_moved": sum(bool(thing["moved"]) for thing in things),
        "n_toppled": sum(bool(thing.get("toppled")) for thing in things),
        "largest_shift": max((thing["shift"] for thing in things), default=None),
    }


def _failures(lines: Sequence[Mapping[str, Any]], objects: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Return the kinds of failure reasons with counts, most frequent first."""
    reasons = [f"{entry['category']}: {kind_of(entry['reason'])}" for entry in objects if not entry["placed"]]
    reasons += [kind_of(line["reason"]) for line in lines if not line["objects"]]
    return dict(Counter(reasons).most_common())


def kind_of(reason: str) -> str:
    """Return a reason without numbers, object names and parentheses, so that equal kinds compare equal."""
    general = re.sub(r"\b(mug|bowl|bottle|can)_\d+\b", "it", reason)
    for _ in range(2):  # parentheses within parentheses
        general = re.sub(r" *\([^()]*\)", "", general)
    general = re.sub(r"-?\d+(\.\d+)?", "N", general)
    return " ".join(general.split())[:120]


def _stages(lines: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    names = dict.fromkeys(name for line in lines for name in line.get("timings", {}))
    return {name: _median(line.get("timings", {}).get(name) for line in lines) for name in names}


def _faults(lines: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return for each kind of fault the episodes in which it occurred: how many are complete, and reasons.

    An episode is complete if all objects are in place, but for one that is lost and reported. Of those that
    are not, ``n_reported`` are those in which the robot gave a reason for every object that is not in place.
    """
    entries: dict[str, list[Any]] = defaultdict(list)
    for line in lines:
        fault = line.get("metrics", {}).get("fault")
        if fault and fault["object"] is not None:
            entries[fault["kind"]].append((fault, line))
    return {kind: _fault_row(rows) for kind, rows in sorted(entries.items())}


def _fault_row(rows: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> dict[str, Any]:
    failed = [(fault, line) for fault, line in rows if not fault["complete"]]
    n_complete = len(rows) - len(failed)
    return {
        "n_episodes": len(rows),
        "n_lost": sum(fault["lost"] for fault, _ in rows),
        "n_complete": n_complete,
        "complete_rate": n_complete / len(rows),
        "complete_rate_ci": wilson_interval(n_complete, len(rows)),
        "n_reported": sum(fault["reported"] for fault, _ in failed),
        "reasons": dict(Counter(kind_of(line["reason"]) for _, line in failed).most_common()),
        "simulated_seconds": _median(line["metrics"].get("simulated_seconds") for _, line in rows),
    }


def _reconstruction(lines: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Return the medians of the reconstruction metrics by class."""
    rows: dict[str, list[Any]] = defaultdict(list)
    for line in lines:
        for row in line.get("metrics", {}).get("reconstruction", ()):
            rows[row["category"]].append(row)
    figures = ("accuracy", "chamfer_l1", "completion", "handle_recall")
    return {
        name: {"n": len(entries), "found": sum(row["found"] for row in entries) / len(entries)}
        | {figure: _median(row.get(figure) for row in entries) for figure in figures}
        for name, entries in sorted(rows.items())
    }


def _resting(lines: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Return how objects were perceived by how they rested, in shares of all.

    ``right`` are those with their class and an axis within ``RIGHT_AXIS``; the medians are theirs.
    """
    rows: dict[str, list[Any]] = defaultdict(list)
    for line in lines:
        for row in line.get("metrics", {}).get("reconstruction", ()):
            if "resting" in row:
                rows["on another" if row["stacked"] else row["resting"]].append(row)
    result: dict[str, dict[str, float | None]] = {}
    for name, entries in sorted(rows.items()):
        named = [row for row in entries if row["found"] and row["perceived"] == row["category"]]
        right = [row for row in named if row["axis_error"] < RIGHT_AXIS]
        shares = {"found": sum(row["found"] for row in entries), "named": len(named), "right": len(right)}
        result[name] = {"n": len(entries)} | {key: count / len(entries) for key, count in shares.items()}
        result[name] |= {
            figure: _median(row[figure] for row in right) for figure in ("chamfer_l1", "completion")
        }
    return result


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
