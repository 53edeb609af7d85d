"""Training of the scene network: losses in closed form, resumed runs."""

import numpy as np
import pytest
import torch

from perception.detection.crop_training import TrainingJob
from perception.detection.scene_patches import UNJUDGED, LabelledScene
from perception.detection.scene_training import (
    SceneTargets,
    SceneTrainingConfig,
    scene_losses,
    train_scene_network,
)
from perception.detection.tasks import CLASSES, SCENE_OUTPUTS, VOTE_UNIT
from perception.errors import PerceptionError
from perception.types import SupportPlane

PLACES = [(0.42, -0.25), (0.55, -0.18)]
SMALL = SceneTrainingConfig(epochs=2, batch=2, side=96)


@pytest.fixture(scope="module")
def picture(scenes):
    solids = [scenes.Solid(x, y, 0.1, radius=0.035) for x, y in PLACES]
    scene = scenes.render(solids, scenes.orbit((0.48, -0.22, 0.05), 0.5, 50, 70))
    feet = np.column_stack([PLACES, np.zeros(len(PLACES))])
    things, label = (scene.instances + 1).astype(np.uint8), np.array([2, 4])
    return LabelledScene(scene.frame, things, label, feet, SupportPlane(np.array([0.0, 0.0, 1.0]), 0.0))


def test_losses_in_closed_form():
    answer = torch.zeros(1, SCENE_OUTPUTS, 4, 4)
    things = torch.zeros(1, 8, 8, dtype=torch.uint8)
    things[:, :4] = 1
    label = torch.full((1, 4, 4), -1)
    label[:, :2] = 1
    offset = torch.zeros(1, 4, 4, 2)
    offset[:, :2, :, 0] = 10.0
    pixel, weight = torch.full((1, 4, 4), 0.003), (label >= 0).float()
    config = SceneTrainingConfig(foreground_weight=1, class_weight=1, vote_weight=1)
    targets = SceneTargets(things, label, offset, pixel, weight)
    loss = scene_losses(answer, targets, config)
    # log 2 for an undecided bit, log 5 for an undecided class, 10 pixels of 3 mm with a spread of 1 cm
    assert loss.tolist() == pytest.approx([np.log(2), np.log(5), 3.0], rel=1e-3)
    answer[:, 4 + CLASSES] = 10.0 / VOTE_UNIT
    better = scene_losses(answer, targets, config)
    assert better[2] < 0.02 and better[1] == loss[1]


def test_unjudged_pixels_are_in_no_loss():
    """Whatever the network says where object and background are both right, the losses stay."""
    targets = SceneTargets(
        torch.full((1, 8, 8), UNJUDGED, dtype=torch.uint8), torch.full((1, 4, 4), -1),
        torch.zeros(1, 4, 4, 2), torch.full((1, 4, 4), 0.003), torch.zeros(1, 4, 4),
    )  # fmt: skip
    answer = torch.randn(1, SCENE_OUTPUTS, 4, 4, generator=torch.Generator().manual_seed(0))
    assert scene_losses(answer, targets, SceneTrainingConfig()).tolist() == [0, 0, 0]


def test_an_interrupted_run_ends_like_an_uninterrupted_one(picture, tmp_path, monkeypatch):
    def train(directory, progress=None, pictures=lambda _: picture):
        return train_scene_network(pictures, 4, SMALL, TrainingJob(directory, progress=progress))

    whole = train(tmp_path / "a").state_dict()
    seen = []

    def broken(index):
        seen.append(index)
        if len(seen) > 6:
            raise KeyboardInterrupt
        return picture

    monkeypatch.setattr("perception.detection.scene_training._SAVE_EVERY", 0.0)
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "b", pictures=broken)
    resumed = train(tmp_path / "b").state_dict()
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)
    with pytest.raises(PerceptionError, match="another configuration"):
        train_scene_network(lambda _: picture, 4, SceneTrainingConfig(), TrainingJob(tmp_path / "b"))
