"""Data sets of rendered scenes: ground truth at the reduced resolution, round trip, shards, splits."""

from dataclasses import replace

import numpy as np
import pytest

import app.training.scene_dataset as pictures
from app.training.crop_dataset import LabelledCrops
from app.training.scene_dataset import (
    IGNORED,
    LabelledScenes,
    Shard,
    downscale_image,
    load_crops,
    load_scenes,
    render_shard,
    render_shards,
    training_scene_config,
)
from perception.detection.scene_patches import UNJUDGED
from perception.errors import PerceptionError
from perception.types import SupportPlane
from sim_assets.datasets.scene_config import TrainingSceneConfig
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
        assert picture.foot[index] == pytest.approx(label.foot, abs=1e-6)
    depth = image.frame.depth
    assert np.median(picture.frame.depth[picture.frame.depth > 0]) == pytest.approx(
        np.median(depth[depth > 0]), abs=0.01
    )


def test_things_around_the_table_are_not_judged(image, small):
    """An object in front of them keeps its number; without an object both answers are right."""
    around = np.zeros(image.instances.shape, bool)
    around[:, :320] = True
    things = downscale_image(replace(image, surroundings=around)).things[0]
    before = small.things[0]
    beside = (before == 0) & (np.arange(320) < 160)
    assert beside.any() and (things[beside] == UNJUDGED).all()
    assert (things[~beside] == before[~beside]).all()


def test_round_trip_and_damaged_files(small, tmp_path):
    (tmp_path / "a.npz").write_bytes(small.packed())
    again = LabelledScenes.concatenate([LabelledScenes.load(tmp_path / "a.npz")] * 2)
    assert len(again) == 2
    np.testing.assert_array_equal(again.depth[1], small.depth[0])
    (tmp_path / "b.npz").write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(PerceptionError, match=r"b\.npz holds no scenes"):
        LabelledScenes.load(tmp_path / "b.npz")


def test_ignored_objects_have_no_class(image):
    ignored = replace(image, labels=tuple(replace(label, ignored=True) for label in image.labels))
    scene = downscale_image(ignored)
    assert (scene.label[0, : len(image.labels)] == IGNORED).all()
    assert (scene.labelled(0).label[: len(image.labels)] == -1).all()


def test_the_plane_is_the_one_that_the_image_shows(image):
    sunk = replace(image, plane=SupportPlane(np.array([0.0, 0.6, 0.8]), -0.02))
    plane = downscale_image(sunk).labelled(0).plane
    np.testing.assert_allclose([*plane.normal, plane.offset], [0, 0.6, 0.8, -0.02])


def test_finished_shards_are_not_rendered_again(tmp_path, monkeypatch):
    rendered = []

    def render(shard):
        rendered.append((shard.number, shard.count))
        return b"crops", b"scenes"

    monkeypatch.setattr(pictures, "render_shard", render)
    render_shards(tmp_path, "train", pictures.SHARD + 10, seed=0)
    again = render_shards(tmp_path, "train", pictures.SHARD + 10, seed=0)
    assert rendered == [(0, pictures.SHARD), (1, 10)]
    assert [shard.number for shard in again] == [0, 1]
    assert (again[0].crops.read_bytes(), again[0].scenes.read_bytes()) == (b"crops", b"scenes")
    again[1].scenes.unlink()  # interrupted between the two files
    render_shards(tmp_path, "train", pictures.SHARD + 10, seed=0)
    assert rendered[2:] == [(1, 10)]


def test_shards_without_images_have_the_same_crops(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "training_scene_config", lambda: CONFIG)
    shard = Shard(tmp_path, "train", 0, 0, 1)
    alone = replace(shard, crops_only=True)
    assert alone.files == shard.files[:1]
    assert render_shard(alone) == render_shard(shard)[:1]
    monkeypatch.setattr(pictures, "render_shard", lambda shard: (b"crops",))
    (found,) = render_shards(tmp_path, "train", 1, seed=0, crops_only=True)
    assert found.crops.read_bytes() == b"crops" and not found.scenes.exists()


def test_a_share_of_the_images_of_a_shard_has_stacks(tmp_path, monkeypatch):
    used = []

    class Recorded(TrainingScenes):
        def __init__(self, split, seed, config):
            used.append(config.stacked)
            super().__init__(split, seed, CONFIG)

    monkeypatch.setattr("sim_assets.datasets.training_scenes.TrainingScenes", Recorded)
    render_shards(tmp_path, "train", 1, seed=3, crops_only=True, stacked=0.5)
    render_shards(tmp_path, "train", 1, seed=4, crops_only=True)
    assert used == [0.5, 0.0]


def test_where_most_objects_are_mugs_these_have_crops_of_their_bodies_too(tmp_path, monkeypatch):
    shares, asked = [], []

    class Recorded(TrainingScenes):
        def __init__(self, split, seed, config):
            shares.append(config.shares)
            super().__init__(split, seed, CONFIG)

    def bodies(image, masks):
        asked.append(len(masks))
        return masks[:1]

    monkeypatch.setattr("sim_assets.datasets.training_scenes.TrainingScenes", Recorded)
    monkeypatch.setattr(pictures, "bodies_of_mugs", bodies)
    monkeypatch.setattr(pictures, "label_crops", lambda image, plane, masks: crops_of(len(masks)))
    (usual,) = render_shards(tmp_path, "train", 1, seed=3, crops_only=True)
    (mugs,) = render_shards(tmp_path / "mugs", "train", 1, seed=3, crops_only=True, mugs=True)
    assert shares == [training_scene_config().shares, pictures.MUGS] and len(asked) == 1
    assert len(load_crops([mugs.crops])) == len(load_crops([usual.crops])) + 1 == asked[0] + 1


def crops_of(n):
    """Empty crops."""
    zeros = np.zeros(n, np.float32)
    images = np.zeros((n, 64, 64, 6), np.uint8)
    return LabelledCrops(images, np.zeros((n, 2), np.float32), np.zeros(n, int), zeros, zeros)


def test_a_failed_shard_ends_the_job(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "render_shard", lambda shard: 1 / 0)
    with pytest.raises(PerceptionError, match="rendering test scenes: shard 0 crashed: ZeroDivisionError"):
        render_shards(tmp_path, "test", 5, seed=0)


def test_a_shard_holds_images_and_crops_of_its_split(tmp_path, monkeypatch):
    seeds = []

    class Recorded(TrainingScenes):
        def __init__(self, split, seed, config):
            seeds.append((split, seed))
            super().__init__(split, seed, CONFIG)

    monkeypatch.setattr("sim_assets.datasets.training_scenes.TrainingScenes", Recorded)
    shards = [
        Shard(tmp_path, split, seed, number, 1)
        for split, seed, number in (("train", 0, 0), ("test", 0, 0), ("train", 1, 0), ("train", 0, 1))
    ]
    for shard in shards:
        for file, content in zip(shard.files, render_shard(shard), strict=True):
            file.write_bytes(content)
    assert [split for split, _ in seeds] == ["train", "test", "train", "train"]
    assert len({seed for _, seed in seeds}) == 4
    assert len({file for shard in shards for file in (shard.scenes, shard.crops)}) == 8
    assert len(load_scenes([shard.scenes for shard in shards])) == 4
    assert len(load_crops([shard.crops for shard in shards])) >= 4


def test_training_scenes_have_all_sensors_and_other_peoples_rooms():
    config = training_scene_config()
    assert len(config.noises) == 5 and min(config.noises) > 0 and sum(config.noises) == pytest.approx(1)
    assert config.room is not None and config.household > 0.5 and config.misregistered > 0
    assert config.objects[1] + config.extras[1] <= pictures.MAX_THINGS
