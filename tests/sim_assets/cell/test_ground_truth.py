"""Ground truth: poses, masks and contacts of a settled object."""

import numpy as np
import pytest

from sim_assets.cell import ground_truth
from sim_assets.cell.config import CellConfig
from sim_assets.cell.layout import Region
from sim_assets.cell.world import World
from sim_assets.objects import sample_object


@pytest.fixture(scope="module")
def world():
    can = sample_object("can", "train", np.random.default_rng(2))
    region = Region(x=(0.5, 0.5001), y=(-0.1, -0.0999))
    with World(CellConfig((can,), box=None, seed=0, region=region)) as world:
        yield world


def test_a_settled_can_stands_where_it_was_placed(world):
    pose = ground_truth.object_poses(world)[0]
    np.testing.assert_allclose(pose[:3, 3], (0.5, -0.1, 0.0), atol=1e-3)
    assert pose[2, 2] == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)


def test_it_touches_the_table_and_is_not_held(world):
    assert ground_truth.touching(world, 0) == {"world"} and not ground_truth.held(world, 0)


def test_the_mask_shows_it_and_nothing_else(world):
    mask = ground_truth.instance_mask(world, "overview")
    assert set(np.unique(mask)) == {-1, 0} and 50 < (mask == 0).sum() < 20_000
    assert ground_truth.object_models(world)[0].category == "can"


@pytest.mark.parametrize(
    ("bodies", "expected"),
    [
        ({"left_finger", "right_finger"}, True),
        ({"left_finger", "right_finger", "world"}, True),
        ({"left_finger", "world"}, False),
        (set(), False),
    ],
)
def test_an_object_is_held_by_both_fingers(world, monkeypatch, bodies, expected):
    monkeypatch.setattr(ground_truth, "touching", lambda world, index: bodies)
    assert ground_truth.held(world, 0) == expected
