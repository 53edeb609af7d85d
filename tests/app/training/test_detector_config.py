"""Epochs of the networks, and progress of the stages of their training."""

import pytest

from app.training.detector_config import TrainDetectorConfig, stage_progress
from perception.detection.crop_training import TrainingConfig


def test_progress_of_a_stage_is_mapped_to_its_share_of_the_job():
    reported = []
    stage = stage_progress(lambda what, share: reported.append((what, share)), 0.2, 0.6)
    stage("a", 0.0)
    stage("b", 0.5)
    stage("c", 1.0)
    assert reported == [("a", 0.2), ("b", pytest.approx(0.4)), ("c", pytest.approx(0.6))]
    stage_progress(None, 0.0, 1.0)("without a callback", 0.5)


def test_the_scene_network_has_its_share_of_the_epochs_but_at_least_one():
    assert TrainDetectorConfig().scene_epochs == 10
    assert TrainDetectorConfig(training=TrainingConfig(epochs=1)).scene_epochs == 1
