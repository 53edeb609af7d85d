"""Objects that are parts of things of no class, as what is attached to them, their handle or colour tells."""

from __future__ import annotations

from collections.abc import Sequence

from perception.depth_cleaning import clean_frame
from perception.obstacles.attached import carriers_of_parts
from perception.obstacles.crossed import crossed
from perception.obstacles.handled import with_handle
from perception.obstacles.handleless import mugs_without_handle
from perception.obstacles.same_colour import SAME_COLOUR, continued_in_colour
from perception.threads import worker_pool
from perception.types import ObjectEstimate, RejectedObject, RgbdFrame, SupportPlane

CARRIES = "something that belongs to none of the classes is attached to it"
CROSSED = "something that belongs to none of the classes goes through it"
HANDLED = "a handle that belongs to none of the classes begins at it, in its colour"
HANDLELESS = "it has no handle where a mug has one, but goes on in a thing of no class"


def without_parts_of_things(
    found: Sequence[ObjectEstimate],
    stacks: Sequence[Sequence[ObjectEstimate]],
    frames: Sequence[RgbdFrame],
    plane: SupportPlane,
    pieces: Sequence[ObjectEstimate] = (),
    workers: int | None = None,
) -> tuple[list[ObjectEstimate], list[RejectedObject]]:
    """Return the objects without those that go on in things of no class, and these; stacks go as a whole.

    Args:
        found: Estimates of all objects.
        stacks: Those that were segmented as one thing.
        frames: Views with camera poses.
        plane: Support plane.
        pieces: Estimates of what is no object, because its shape does not suffice.
        workers: Number of threads; None for the number of cores.
    """
    views = [clean_frame(frame) for frame in frames]
    with worker_pool(workers) as pool:
        checks = {
            CARRIES: pool.submit(carriers_of_parts, found, views, plane),
            HANDLELESS: pool.submit(mugs_without_handle, found, views, plane),
            SAME_COLOUR: pool.submit(continued_in_colour, found, views, plane),
            CROSSED: pool.submit(crossed, found, views, plane),
            HANDLED: pool.submit(with_handle, found, pieces, views, plane),
        }
        reasons = {id: reason for reason, check in checks.items() for id in check.result()}
    for stack in stacks:
        known = [reasons[part.id] for part in stack if part.id in reasons]
        reasons |= {part.id: known[0] for part in stack if known}
    left = [
        RejectedObject(e.id, e.category, reasons[e.id], e.score, is_part=True)
        for e in found
        if e.id in reasons
    ]
    return [e for e in found if e.id not in reasons], left
