"""Which cells need no look at whether their objects rest."""

import numpy as np
import pytest

from sim_assets.cell.arrangement import Arrangement
from sim_assets.cell.config import CellConfig
from sim_assets.cell.unknown import draw_unknown
from sim_assets.objects import sample_object


def objects():
    return (sample_object("can", "test", np.random.default_rng(0)),)


def test_upright_objects_each_for_itself_are_tidy():
    assert CellConfig(objects()).is_tidy


@pytest.mark.parametrize(
    "change",
    [
        {"arrangement": Arrangement(lying=1)},
        {"drawn_together": True},
        {"unknown": draw_unknown(1, np.random.default_rng(0))},
    ],
)
def test_others_are_not(change):
    assert not CellConfig(objects(), **change).is_tidy
