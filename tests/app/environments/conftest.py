"""A cell with a can and a bowl, and functions to put objects elsewhere."""

import pytest

from app.options import CellOptions
from app.task.cell import build_world


@pytest.fixture(scope="package")
def built_world():
    with build_world(CellOptions(objects="can=1,bowl=1", seed=4), "pack") as world:
        yield world


@pytest.fixture
def cell_world(built_world):
    """The cell; its state is restored afterwards."""
    data = built_world._data
    qpos, qvel = data.qpos.copy(), data.qvel.copy()
    yield built_world
    data.qpos[:], data.qvel[:] = qpos, qvel
