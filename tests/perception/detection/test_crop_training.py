"""Training of the crop networks: learning, resuming, metrics, calibration."""

import numpy as np
import pytest
import torch

from perception.detection.crop_network import (
    CropNet,
    create_member,
    ensemble_of,
    normalise_crops,
    predict,
)
from perception.detection.crop_training import (
    CropSet,
    TrainingConfig,
    TrainingData,
    TrainingJob,
    calibrated_temperature,
    equalise_priors,
    train_crop_network,
    validation_metrics,
)
from perception.detection.crops import SIDE
from perception.detection.tasks import OUTPUTS
from perception.detection.yaw import YAW_BINS, soft_labels
from perception.errors import InvalidInputError, PerceptionError

SMALL = TrainingConfig(epochs=3, batch=16, learning_rate=2e-3)


def synthetic(count, seed=0):
    """Discs with a notch on one side: of five heights for the class, the notch's direction for the yaw."""
    rng = np.random.default_rng(seed)
    label, yaw = rng.integers(5, size=count), rng.uniform(0, 2 * np.pi, count)
    v, u = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    images = np.zeros((count, SIDE, SIDE, 6), np.uint8)
    for image, k, angle in zip(images, label, yaw):
        disc = np.hypot(u, v) < 20
        # Counted from up in the crop, counter-clockwise: up is -v, left is -u.
        notch = np.hypot(u + 22 * np.sin(angle), v + 22 * np.cos(angle)) < 8
        image[disc | notch, 3] = 255
        image[disc | notch, 0] = rng.integers(80, 255)
        image[disc | notch, 4] = 40 + 45 * k
        image[disc | notch, 5] = 127
    context = np.zeros((count, 2), np.float32)
    one_hot = np.eye(5, dtype=np.float32)[label]
    return CropSet(images, context, one_hot), CropSet(images, context, soft_labels(yaw)), yaw


@pytest.mark.parametrize("task", ["class", "yaw"])
def test_training_reduces_the_loss_on_a_simple_task(task, tmp_path):
    which = 0 if task == "class" else 1
    training, validation = synthetic(192)[which], synthetic(32, seed=1)[which]
    reported = []
    job = TrainingJob(tmp_path, progress=lambda *progress: reported.append(progress))
    network = train_crop_network(task, TrainingData(training, validation), SMALL, job)
    assert [(epoch, of) for epoch, of, _ in reported] == [(1, 3), (2, 3), (3, 3)]
    assert reported[-1][2]["loss"] < reported[0][2]["loss"]
    if task == "class":  # the yaw of a few hundred crops takes longer to learn
        assert reported[-1][2]["validation_loss"] < 0.95 * np.log(OUTPUTS[task])
    assert 0.3 <= calibrated_temperature(network, validation) <= 3.0 and not network.training


def test_a_resumed_run_ends_like_an_uninterrupted_one(tmp_path):
    training, validation = synthetic(64)[0], synthetic(32, seed=1)[0]
    config = TrainingConfig(epochs=2, batch=32)

    class Interrupted(Exception):
        pass

    def stop(epoch, epochs, metrics):
        raise Interrupted

    whole = train_crop_network(
        "class", TrainingData(training, validation), config, TrainingJob(tmp_path / "a")
    )
    with pytest.raises(Interrupted):
        train_crop_network(
            "class", TrainingData(training, validation), config, TrainingJob(tmp_path / "b", progress=stop)
        )
    resumed = train_crop_network(
        "class", TrainingData(training, validation), config, TrainingJob(tmp_path / "b")
    )
    assert resumed.features[0][1].num_batches_tracked == whole.features[0][1].num_batches_tracked
    x = normalise_crops(torch.from_numpy(validation.images)), torch.from_numpy(validation.context)
    # Dropout draws from the global generator, so weights agree only nearly.
    assert torch.allclose(whole(*x), resumed(*x), atol=0.5)


def test_training_starts_from_the_given_weights(tmp_path):
    crops = synthetic(32)[0]
    data, start = TrainingData(crops, crops), create_member("class")
    config = TrainingConfig(epochs=1, batch=32, learning_rate=1e-9, warmup=0.0)
    for given in (start, None):
        job = TrainingJob(tmp_path / str(given is None), start=given)
        network = train_crop_network("class", data, config, job)
        assert torch.allclose(network.logits.weight, start.logits.weight, atol=1e-6) == (given is start)


def test_a_checkpoint_of_another_configuration_is_rejected(tmp_path):
    crops = synthetic(32)[0]
    data, job = TrainingData(crops, crops), TrainingJob(tmp_path)
    train_crop_network("class", data, TrainingConfig(epochs=1, batch=32), job)
    with pytest.raises(PerceptionError, match="another configuration"):
        train_crop_network("class", data, TrainingConfig(epochs=2, batch=32), job)


def test_targets_of_the_wrong_width_are_rejected(tmp_path):
    crops = synthetic(8)[0]
    with pytest.raises(InvalidInputError, match=r"for 'yaw' must have .n > 0, 36. targets"):
        train_crop_network("yaw", TrainingData(crops, crops), SMALL, TrainingJob(tmp_path))


def test_predictions_of_mirrored_crops_are_mirrored():
    torch.manual_seed(0)
    crops = synthetic(6)[1]
    images, context = crops.images, crops.context
    flipped = np.ascontiguousarray(images[:, :, ::-1])
    for task in ("class", "yaw"):
        network = CropNet(OUTPUTS[task]).eval()
        seen, mirrored = (predict(network, 1.0, i, context) for i in (images, flipped))
        if task == "yaw":
            mirrored = np.roll(mirrored, -1, axis=1)[:, ::-1]
        assert mirrored == pytest.approx(seen, abs=1e-6)


def test_the_temperature_corrects_overconfidence():
    """Confidence 0.99 at an accuracy of 0.75 needs a temperature of about 2.4."""
    crops = synthetic(200)[0]
    targets = crops.targets.copy()
    targets[:50] = np.roll(targets[:50], 1, axis=1)

    class Overconfident(CropNet):
        def forward(self, images, context):
            return 6.0 * torch.from_numpy(crops.targets)

    expected = 6.0 / np.log(0.75 / (0.25 / 4))
    found = calibrated_temperature(Overconfident(5), CropSet(crops.images, crops.context, targets))
    assert found == pytest.approx(expected, rel=0.15)


def test_metrics_of_a_perfect_network():
    crops = synthetic(16)[1]
    ahead = soft_labels(np.pi * (np.arange(16) % 2))  # its own mirror image
    crops = CropSet(crops.images, crops.context, ahead)

    class Oracle(CropNet):
        def forward(self, images, context):
            return torch.log(torch.from_numpy(crops.targets) + 1e-9)

    assert validation_metrics("yaw", Oracle(YAW_BINS), crops)["yaw_median"] == 0.0


@pytest.mark.parametrize("members", [1, 2])
def test_logits_of_classes_are_shifted_by_their_frequencies_and_other_is_not(members):
    network = ensemble_of([CropNet(5) for _ in range(members)]).eval()
    targets = np.eye(5, dtype=np.float32)[[0] * 8 + [1] * 2 + [2] * 4 + [3] * 2 + [4] * 30]
    images, context = torch.rand(3, 6, 64, 64), torch.rand(3, 2)
    with torch.no_grad():
        before = network(images, context)
        equalise_priors(network, targets)
        shift = network(images, context) - before
    expected = np.log([4 / 8, 4 / 2, 4 / 4, 4 / 2, 1.0])
    np.testing.assert_allclose(shift, np.tile(expected, (3, 1)), atol=1e-5)
