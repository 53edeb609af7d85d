"""A plan, and a cell in which nothing moves."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from manipulation.standing import to_standing
from manipulation.types import Box, Placement, TaskPlan
from sim_assets.cell.world import World


class StillWorld(World):
    """The members of the cell that storing a run needs; counts the images that are rendered."""

    def __init__(self):
        pass

    time = 1.5
    config = SimpleNamespace(scale=1.0)
    drawn = 0

    def overview_image(self, *size, camera="overview", **_):
        self.drawn += 1
        width, height = size or (96, 72)
        return np.zeros((height, width, 3), np.uint8)

    def observe(self, observer, rate=0.0):
        self.observer = observer

    def joint_positions(self):
        return np.zeros(7)

    def gripper_width(self):
        return 0.08


@pytest.fixture
def still_world() -> StillWorld:
    return StillWorld()


@pytest.fixture
def pack_plan(can_at) -> TaskPlan:
    """Two cans, of which the first one is placed in the middle of the box."""
    items = {estimate.name: to_standing(estimate) for estimate in (can_at(0), can_at(1, 0.5))}
    placements = (Placement("can_0", (0.5, 0.27, 0.004), (0.0,)),)
    return TaskPlan("pack", items, placements, {"can_1": "too far"}, box=Box())
