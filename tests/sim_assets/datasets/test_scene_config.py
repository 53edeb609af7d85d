"""Defaults of the scene distributions: the evaluation's scenes, and the limits of varied rooms."""

import numpy as np

from perception.types import CATEGORIES
from sim_assets.datasets.scene_config import RoomConfig, TrainingSceneConfig
from sim_assets.rendering.depth_noise import DEPTH_NOISES


def test_default_distributions():
    config = TrainingSceneConfig()
    assert len(config.noises) == len(DEPTH_NOISES) and sum(config.noises) == 1
    assert len(config.shares) == len(CATEGORIES)
    assert (config.width, config.height, config.pool, config.distractors) == (320, 240, 40, 14)
    assert config.fovy == (42.0, 50.0) and config.distance == (0.35, 0.85)
    assert config.room is None and config.household == config.toppled == config.misregistered == 0


def test_walls_are_behind_every_table():
    room = RoomConfig()
    assert room.wall[0] < room.wall[1] and room.side[0] < room.side[1]
    assert np.all(np.array(room.drop) > 0)
