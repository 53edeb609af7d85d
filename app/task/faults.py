"""Faults of an episode: how one is put into the cell, and what it counts as."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from app.options import TaskOptions
from app.runs.report import ObjectReport

if TYPE_CHECKING:
    from app.task.task_types import TaskResult
    from sim_assets.cell.faults import FaultyRobot
    from sim_assets.cell.world import World

REACH = 0.85  # [m] from the base, beyond which an object on the table counts as lost


def faulty_robot(world: World, options: TaskOptions) -> FaultyRobot | None:
    """Return the robot of a cell on whose table the fault of the options occurs; None without a fault."""
    if options.fault == "none":
        return None
    from sim_assets.cell.faults import KINDS, FaultyRobot

    kind = KINDS[options.seed % len(KINDS)] if options.fault == "any" else options.fault
    return FaultyRobot(world, kind, options.seed)


def judge_fault(
    record: Mapping[str, Any],
    objects: Sequence[ObjectReport],
    result: TaskResult,
    poses: Mapping[int, Float[np.ndarray, "4 4"]],
) -> dict[str, Any]:
    """Return the fault with its outcome.

    Args:
        record: Kind, object and time of the fault; no object if it did not occur.
        objects: Score of each object, in the order of their numbers.
        result: Results of the pipeline.
        poses: True poses at the end, by number.

    Returns:
        ``record`` with ``lost`` (the object is off the table or out of reach), ``reported`` (the robot gives
        a reason for every object that is not in place), ``complete`` (all objects are in place, but for a
        lost one that is reported) and ``reason`` of the object.
    """
    number: int | None = record["object"]
    wrong = [entry for entry in objects if not entry.placed]
    claimed = {outcome.id for outcome in result.outcomes if outcome.placed}
    reported = all(entry.id not in claimed for entry in wrong)
    lost = number is not None and _is_lost(poses[number][:3, 3])
    lost_entry = objects[number] if number is not None and lost else None
    rest = [entry for entry in wrong if entry is not lost_entry]
    return {
        **record,
        "lost": lost,
        "reported": reported,
        "complete": not rest and (not lost or reported),
        "reason": "" if number is None else objects[number].reason,
    }


def _is_lost(position: np.ndarray) -> bool:
    return bool(position[2] < -0.05 or np.linalg.norm(position[:2]) > REACH)
