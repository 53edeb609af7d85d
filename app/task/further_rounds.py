"""Rounds of a task after the first: another look at the table, and what is to be placed again.

``app.task.rounds`` merges their results.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from app.task.fallen import (
    fallen_objects,
    is_something_lost,
    items_left,
    left_in_box,
    with_lost_found,
    without_gone,
)
from app.task.further_views import MOST_CLOSER
from app.task.hidden_places import may_hide_an_object
from app.task.nests import with_bowls_named
from app.task.obstacles import bounds_of, filled_bounds, known_bounds, obstacles_during, table_of
from app.task.rounds import (
    as_first_seen,
    has_changed,
    is_something_left,
    placed_estimates,
    placed_items,
    places_of_left,
    renumbered,
    unplaced_estimates,
    with_round,
    without_covered,
)
from app.task.row_order import partly_hidden, with_sizes_measured
from app.task.stages import FULL_SCAN, Stages, prior_reconstruction
from app.task.task_types import TaskResult
from app.task.unchanged import (
    ScannedRound,
    parts_as_before,
    with_judged,
    without_instances,
)
from manipulation.errors import ManipulationError
from manipulation.further_packing import loose_bowl, plan_further
from manipulation.further_sorting import out_of_order, plan_further_sort
from manipulation.types import Box, Line, StandingObject, TaskPlan
from perception.errors import PerceptionError
from perception.obstacles.obstacle import PerceivedObstacle
from perception.pipeline import Detections
from perception.types import ObjectEstimate

logger = logging.getLogger(__name__)


class FurtherRounds:
    """Further rounds of a task.

    Args:
        stages: The stages, which are repeated.
    """

    def __init__(self, stages: Stages) -> None:
        self._stages = stages
        self._seen: ScannedRound | None = None  # by the last round but the first
        self._tried_in_box: set[int] = set()  # what was left in the box and has been planned for once more
        self._remeasured: set[int] = set()  # objects on the rows
        self._has_looked_behind = False  # what was taken away
        self._nested: set[int] = set()  # bowls that were to go into others once all was packed

    def place_again(self, result: TaskResult) -> TaskResult | None:
        """Return the results after what is not as it was to be was placed again; None if nothing was.

        In the box that is what fell, leans, was turned or does not nest, on the rows what is out of order.
        What is not in the box any more is not placed in the results, and may be on the table.
        """
        box, is_any_gone = self._stages.request.filled_box, False
        if box is None:
            result, wrong = self._out_of_order(result)
        else:
            before, result = result, without_gone(result, box)
            is_any_gone = result is not before
            placed = placed_estimates(result)
            wrong = fallen_objects(placed, result.checks, result.final_frames, box)
            if not wrong:
                result, wrong = self._with_loose_bowl(result, box)
        if not wrong or result.detections is None:
            return result if is_any_gone else None
        names = {estimate.name for estimate in wrong}
        beside = [e for e in placed_estimates(result).values() if e.name not in names]
        items = {name: item for name, item in placed_items(result).items() if name not in names}
        try:
            with self._stages.observer.stage("plan"):
                plan = replace(self._plan(result, wrong, items), obstacles=result.obstacles)
        except (ManipulationError, PerceptionError) as error:
            logger.info("%s cannot be placed again: %s", ", ".join(sorted(names)), error)
            return result if is_any_gone else None
        again = self._carry_out(result, wrong, plan, beside, result.obstacles, result.detections)
        return as_first_seen(again, result)

    def _out_of_order(self, result: TaskResult) -> tuple[TaskResult, list[ObjectEstimate]]:
        """Return the results with sizes measured on the rows, and what is out of order, each once at most."""
        stages = self._stages
        if stages.request.reconstruction is not None or result.plan is None:
            return result, []
        hidden = partly_hidden(result) - self._remeasured
        if not hidden:
            return result, []
        self._remeasured |= hidden
        with stages.observer.stage("verify"):
            result = with_sizes_measured(result, hidden, stages.perception, stages.look_at)
        wrong = out_of_order(placed_items(result), self._lines(result))
        standing = (e for _, e in sorted(placed_estimates(result).items()) if e.name in wrong)
        return result, [replace(estimate, resting="upright", rests_on=None) for estimate in standing]

    def _with_loose_bowl(self, result: TaskResult, box: Box) -> tuple[TaskResult, list[ObjectEstimate]]:
        """Return the results with all bowls named, and one that is to go into another, each once at most."""
        stages = self._stages
        if stages.request.reconstruction is None:
            result = with_bowls_named(result, box, stages.perception)
        bowl = loose_bowl(placed_items(result), box, stages.settings.for_arm(stages.robot.arm))
        if bowl is None or bowl.id in self._nested:
            return result, []
        self._nested.add(bowl.id)
        return result, [placed_estimates(result)[bowl.id]]

    def _carry_out(
        self,
        result: TaskResult,
        found: Sequence[ObjectEstimate],
        plan: TaskPlan,
        others: Sequence[ObjectEstimate],
        obstacles: Sequence[PerceivedObstacle],
        detections: Detections,
    ) -> TaskResult:
        """Return the results with those of the plan of one more round.

        Args:
            result: Results of the rounds before.
            found: Objects that the plan has goals for.
            plan: The plan.
            others: Objects that have their places, or are stuck in the box.
            obstacles: Things of no class.
            detections: Detections, of which the surface of the table is used.
        """
        planned, observer = with_round(result, found, plan, (), obstacles), self._stages.observer
        assert planned.plan is not None
        observer.on_objects(planned.objects)
        observer.on_obstacles(obstacles)
        observer.on_plan(planned.plan)
        outcomes = self._stages.execute(plan, [*others, *found], detections)
        return with_round(result, found, plan, outcomes, obstacles)

    def look_again(self, result: TaskResult, is_last: bool) -> TaskResult | None:
        """Return the results with those of one more round; None if there is nothing more to do."""
        stages = self._stages
        request, observer = stages.request, stages.observer
        box, n_rejected = request.filled_box, len(observer.rejected)
        is_left = is_something_left(result, stages.latest)
        if not is_left and not self._may_hide_an_object(result):
            return None
        self._has_looked_behind = True
        try:
            if box is not None and is_something_lost(result):
                result = with_lost_found(result, stages.look_into_box(), box)
            frames = stages.scan(FULL_SCAN if is_left else request.scan_views)
            n_scanned = len(frames)
            frames += stages.capture_nearby(places_of_left(stages.latest, box)[:MOST_CLOSER])
            placed = list(placed_estimates(result).values())
            on_rows = () if box else placed
            known = [known_bounds(request.box), bounds_of(on_rows)]
            detections = stages.detect(frames, filled_bounds(box) if box else np.concatenate(known))
            assert result.detections is not None
            before = self._seen or ScannedRound(
                result.frames, result.detections, result.rejected, result.objects
            )
            detections = with_judged(detections, frames, before, unplaced_estimates(result), n_scanned)
            parts = parts_as_before(detections, frames, before, n_scanned)
            with observer.stage("reconstruct"):
                for part in parts:
                    observer.on_rejected(part)
                # The ids of these fits are not yet those of the objects.
                reconstruct = request.reconstruction or prior_reconstruction(
                    stages.perception, observer, shows_fits=False
                )
                whole = without_instances(detections, [part.id for part in parts])
                found = renumbered(reconstruct(frames, whole), result.objects, box, on_rows)
                self._seen = ScannedRound(
                    frames, detections, tuple(observer.rejected[n_rejected:]), tuple(found)
                )
                left = left_in_box(result, box) if box else []
                found += [estimate for estimate in left if estimate.id not in self._tried_in_box]
                stuck = [estimate for estimate in left if estimate.id in self._tried_in_box]
                self._tried_in_box |= {estimate.id for estimate in left}
                table = table_of(detections)
                others, any_box = [*placed, *stuck], box or request.box
                obstacles = obstacles_during([*others, *found], frames, table, any_box, stages.robot.arm)
            with observer.stage("plan"):
                items = placed_items(result) | items_left(result, stuck)
                plan = replace(self._plan(result, found, items), obstacles=obstacles)
                if has_changed(stages.latest) and not is_last:
                    plan = without_covered(plan, found)
        except (ManipulationError, PerceptionError) as error:
            logger.info("nothing more to do: %s", error)
            return None
        result = replace(result, rejected=tuple(observer.rejected[n_rejected:]))
        further = self._carry_out(result, found, plan, others, obstacles, detections)
        return as_first_seen(further, result)

    def _may_hide_an_object(self, result: TaskResult) -> bool:
        """Return whether an object may stand where the scan has shown nothing, before it is looked for."""
        stages = self._stages
        if self._has_looked_behind or not stages.request.uncertainty or result.detections is None:
            return False
        area, plane = stages.settings.free_area, table_of(result.detections).plane
        return may_hide_an_object(result.frames, result.objects, area, plane)

    def _plan(
        self, result: TaskResult, found: Sequence[ObjectEstimate], items: Mapping[str, StandingObject]
    ) -> TaskPlan:
        """Return the plan for what was found, beside what has its place or is stuck in the box, by name.

        Raises:
            PlanningError: nothing can be placed.
        """
        stages = self._stages
        request, arm, settings = stages.request, stages.robot.arm, stages.settings
        if request.filled_box:
            return plan_further(found, items, request.filled_box, arm, settings, stages.kinematics)
        lines = self._lines(result)
        return plan_further_sort(
            found, items, lines, request.line, arm, settings, request.box, stages.kinematics
        )

    def _lines(self, result: TaskResult) -> Sequence[Line]:
        """Return the rows of a task that sorts."""
        assert result.plan is not None
        return result.plan.lines or (self._stages.request.line,)
