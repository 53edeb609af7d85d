"""What is changed in a cell that cannot be laid out, and that every seed gives a scene."""

from itertools import pairwise

import numpy as np
import pytest

from app.options import PackOptions
from app.task.cell import build_world
from app.task.fitting_cell import Freedom, fitting_world, width, with_a_smaller_object
from sim_assets.cell import ground_truth
from sim_assets.cell.arrangement import Arrangement
from sim_assets.cell.config import CellConfig
from sim_assets.cell.layout import ArrangementError, LayoutError, UnstableError
from sim_assets.cell.resting import tilt
from sim_assets.cell.unknown import draw_unknown
from sim_assets.cell.world import World
from sim_assets.objects import sample_object


@pytest.fixture
def attempts(monkeypatch):
    """Return the configurations that are tried when the first worlds fail with the given errors."""

    def run(config, errors, **freedom):
        rng = np.random.default_rng(0)
        tried, left = [], list(errors)

        def build(self, config):
            tried.append(config)
            if left:
                raise left.pop(0)

        monkeypatch.setattr(World, "__init__", build)
        allowed = {
            "draw": lambda category: sample_object(category, "test", rng),
            "draw_thing": lambda: draw_unknown(1, rng)[0],
            "smaller_gap": False,
            "fewer_poses": False,
        }
        fitting_world(config, Freedom(**allowed | freedom))
        return tried

    return run


@pytest.fixture(scope="module")
def config():
    rng = np.random.default_rng(1)
    objects = tuple(sample_object(category, "test", rng) for category in ("bowl", "can", "mug"))
    return CellConfig(objects=objects, unknown=draw_unknown(2, rng), arrangement=Arrangement(lying=1))


def replaced(before, after):
    return [i for i, (a, b) in enumerate(zip(before, after, strict=True)) if a is not b]


def test_what_fits_is_left_as_it_is(attempts, config):
    assert attempts(config, []) == [config]


def test_a_body_that_falls_is_replaced_and_no_other(attempts, config):
    errors = [UnstableError("object1 fell", "object1"), UnstableError("unknown0 fell", "unknown0")]
    first, second, third = attempts(config, errors)
    assert replaced(first.objects, second.objects) == [1] and first.unknown == second.unknown
    assert second.objects == third.objects and replaced(second.unknown, third.unknown) == [0]
    assert second.objects[1].category == "can"


def test_without_room_the_widest_is_replaced_by_a_narrower_one(attempts, config):
    tried = attempts(config, [LayoutError("no room")] * 2)
    for before, after in pairwise(tried):
        (index,) = replaced(before.objects, after.objects)
        assert width(after.objects[index]) < width(before.objects[index])


def test_gaps_shrink_only_if_nobody_asked_for_them(attempts, config):
    errors = [LayoutError("no room")] * 2
    gaps = [c.min_gap for c in attempts(config, errors, draw=None, smaller_gap=True)]
    assert gaps == [0.04, 0.02, 0.01]
    with pytest.raises(LayoutError, match="no room"):
        attempts(config, errors, draw=None)


def test_poses_that_no_objects_rest_in(attempts, config):
    errors = [ArrangementError("lying", 1, 0)] * 3
    tried = attempts(config, errors, fewer_poses=True)
    assert [c.arrangement.at_most for c in tried] == [False, False, False, True]
    assert replaced(tried[0].objects, tried[1].objects) == [0, 1, 2]
    with pytest.raises(LayoutError, match="--lying 1: only 0 of these objects rest that way"):
        attempts(config, errors)


def test_nothing_narrower_is_no_replacement(config):
    by_class = {model.category: model for model in config.objects}
    assert with_a_smaller_object(config.objects, by_class.__getitem__) is None


@pytest.mark.slow
@pytest.mark.parametrize("objects", ["6", "8", "12", "bowl=12", "mug=12", "bottle=12", "can=12"])
@pytest.mark.parametrize("clutter", [False, True])
def test_every_seed_gives_a_scene(objects, clutter):
    for seed in range(700, 703):
        with build_world(PackOptions(objects=objects, seed=seed, clutter=clutter), "pack") as world:
            assert len(world.config.objects) == sum(int(part.split("=")[-1]) for part in objects.split(","))
            poses = ground_truth.object_poses(world).values()
            assert min(T[2, 3] for T in poses) > -0.01
            assert clutter or max(tilt(T) for T in poses) < np.deg2rad(2)
