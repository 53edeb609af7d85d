"""Data sets of rendered scenes: ground truth at the reduced resolution, round trip, shards, splits."""

import numpy as np
import pytest

import app.training.scene_dataset as pictures
from app.training.crop_dataset import LabelledCrops
from app.training.scene_dataset import (
    LabelledScenes,
    downscale_image,
    load_crops,
    load_scenes,
    render_crop_shards,
    render_scene_shards,
)
from perception.errors import PerceptionError
from sim_assets.datasets.table_top import TrainingSceneConfig
from sim_assets.datasets.training_scenes import TrainingScenes

CONFIG = TrainingSceneConfig(
    width=640, height=480, pool=4, distractors=2, objects=(3, 4), extras=(1, 1), textures_redrawn=2, shadows=0
)


@pytest.fixture(scope="module")
def image():
    with TrainingScenes("train", 3, CONFIG) as scenes:
        return next(scenes.render(1))


@pytest.fixture(scope="module")
def small(image):
    return downscale_image(image)


def test_reduced_images_keep_objects_and_footprints(image, small):
    assert small.rgb.shape == (1, 240, 320, 3) and small.things.shape == (1, 240, 320)
    picture = small.labelled(0)
    share = (picture.things > 0).mean() / (image.instances >= 0).mean()
    assert share == pytest.approx(1, abs=0.05)
    assert set(np.unique(picture.things)) - {0} <= set(np.unique(image.instances + 1))
    for index, label in enumerate(image.labels):
        assert picture.label[index] == (
            4 if label.category is None else pictures.CATEGORIES.index(label.category)
        )
        assert picture.foot[index] == pytest.approx(label.T_world_object[:2, 3], abs=1e-6)
    depth = image.frame.depth
    assert np.median(picture.frame.depth[picture.frame.depth > 0]) == pytest.approx(
        np.median(depth[depth > 0]), abs=0.01
    )


def test_round_trip_and_damaged_files(small, tmp_path):
    small.save(tmp_path / "a.npz")
    again = LabelledScenes.concatenate([LabelledScenes.load(tmp_path / "a.npz")] * 2)
    assert len(again) == 2
    np.testing.assert_array_equal(again.depth[1], small.depth[0])
    (tmp_path / "b.npz").write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(PerceptionError, match=r"b\.npz holds no scenes"):
        LabelledScenes.load(tmp_path / "b.npz")


def test_finished_shards_are_not_rendered_again(small, tmp_path, monkeypatch):
    rendered = []
    empty = LabelledCrops(
        np.zeros((1, 64, 64, 6), np.uint8), np.zeros((1, 2), np.float32), np.zeros(1, int),
        np.zeros(1, np.float32), np.zeros(1, np.float32),
    )  # fmt: skip

    monkeypatch.setattr(
        pictures, "_render_scenes", lambda split, count, seed: rendered.append(count) or small
    )
    render_scene_shards(tmp_path, "train", pictures.SHARD + 10, seed=0)
    paths = render_scene_shards(tmp_path, "train", pictures.SHARD + 10, seed=0)
    assert rendered == [pictures.SHARD, 10]
    assert len(load_scenes(paths)) == 2

    monkeypatch.setattr(
        pictures, "_render_close_ups", lambda split, count, kind, seed: rendered.append(count) or empty
    )
    render_crop_shards(tmp_path, "train", pictures.SHARD + 20, seed=0)
    assert len(load_crops(render_crop_shards(tmp_path, "train", pictures.SHARD + 20, seed=0))) == 2
    assert rendered[2:] == [pictures.SHARD, 20]
    assert render_crop_shards(tmp_path, "test", 20, seed=0) != render_crop_shards(
        tmp_path, "train", 20, seed=0
    )


class PoolDrawn(Exception):
    """Raised in place of rendering."""


@pytest.mark.parametrize("split", ["train", "test"])
@pytest.mark.parametrize("render", ["scenes", "crops"])
def test_scenes_are_rendered_from_the_asked_split_with_a_seed_per_shard(tmp_path, monkeypatch, split, render):
    calls = []

    class Recorded:
        def __init__(self, split, seed, config):
            calls.append((split, seed))
            raise PoolDrawn

    monkeypatch.setattr("sim_assets.datasets.training_scenes.TrainingScenes", Recorded)
    function = render_scene_shards if render == "scenes" else render_crop_shards
    for seed in (0, 1):
        with pytest.raises(PoolDrawn):
            function(tmp_path, split, 3, seed)
    assert [call[0] for call in calls] == [split, split] and calls[0][1] != calls[1][1]
