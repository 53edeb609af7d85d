"""Shapes in shards: the same for any number of workers as in one piece; caches of other jobs."""

import numpy as np
import pytest

from app.jobs import Workers
from app.training import shape_samples
from app.training.shape_samples import cached_shapes, list_shards, sample_shard
from perception.errors import PerceptionError
from perception.shape.dataset import ShapeDataset
from sim_assets.objects.training_grids import sample_training_grids

COUNTS = {"mug": 5, "bowl": 0, "bottle": 4, "can": 1}


@pytest.mark.parametrize("workers", [1, 2])
def test_shards_hold_the_shapes_of_the_seed_in_order(tmp_path, monkeypatch, workers):
    monkeypatch.setattr(shape_samples, "SHARD", 2)
    data = cached_shapes(tmp_path / "shapes.npz", COUNTS, "train", 3, Workers(workers))
    expected = ShapeDataset.from_grids({c: sample_training_grids(c, n, 3) for c, n in COUNTS.items()})
    np.testing.assert_array_equal(data.grids, expected.grids)
    np.testing.assert_array_equal(data.categories, expected.categories)
    assert [path.name for path in tmp_path.iterdir()] == ["shapes.npz"]  # and no shards


def test_finished_shards_are_reused(tmp_path, monkeypatch):
    monkeypatch.setattr(shape_samples, "SHARD", 2)
    shards = list_shards(tmp_path / "shapes", COUNTS, "test", 0)
    assert [(s.category, s.first, s.count, s.number) for s in shards] == [
        ("mug", 0, 2, 0), ("mug", 2, 2, 1), ("mug", 4, 1, 2),
        ("bottle", 0, 2, 3), ("bottle", 2, 2, 4), ("can", 0, 1, 5),
    ]  # fmt: skip
    (content,) = sample_shard(shards[1])
    (tmp_path / "shapes").mkdir()
    shards[1].files[0].write_bytes(content)
    sampled = []
    monkeypatch.setattr(shape_samples, "sample_shard", lambda s: sampled.append(s.number) or sample_shard(s))
    data = cached_shapes(tmp_path / "shapes.npz", COUNTS, "test", 0)
    assert sampled == [0, 2, 3, 4, 5]
    np.testing.assert_array_equal(data.of("mug").grids, sample_training_grids("mug", 5, 0, "test"))


def test_data_of_another_job_are_not_taken(tmp_path):
    counts = {"mug": 1, "bowl": 0, "bottle": 0, "can": 1}
    path = tmp_path / "shapes.npz"
    first = cached_shapes(path, counts, "train", 0)
    assert (cached_shapes(path, counts, "train", 0).grids == first.grids).all()
    with pytest.raises(PerceptionError, match="other shapes than asked for; delete it"):
        cached_shapes(path, counts | {"can": 2}, "train", 0)
