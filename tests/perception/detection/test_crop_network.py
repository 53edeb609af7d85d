"""Crop networks: ensembles, normalisation, mirror averaging, weights files."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from perception.detection.crop_network import (
    CropNet,
    create_network,
    ensemble_of,
    load_crop_network,
    mirror_averaged_logits,
    mirror_yaw_bins,
    normalise_crops,
    predict,
    save_crop_network,
)
from perception.detection.crop_training import CropSet
from perception.detection.crops import SIDE
from perception.detection.tasks import ENSEMBLE_SIZE, OUTPUTS
from perception.detection.yaw import YAW_BINS, soft_labels
from perception.errors import PerceptionError


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


def test_an_ensemble_averages_logits_and_can_be_saved(tmp_path, monkeypatch):
    monkeypatch.setitem(ENSEMBLE_SIZE, "class", 2)
    torch.manual_seed(0)
    ensemble = create_network("class").eval()
    members = list(ensemble.members)
    crops = synthetic(6)[0]
    images, context = normalise_crops(torch.from_numpy(crops.images)), torch.from_numpy(crops.context)
    mean = sum(member(images, context) for member in members) / len(members)
    assert torch.allclose(ensemble(images, context), mean, atol=1e-6)
    save_crop_network(ensemble, tmp_path / "c.safetensors", "class", 1.2)
    loaded, temperature = load_crop_network("class", tmp_path / "c.safetensors")
    assert temperature == 1.2 and torch.equal(loaded(images, context), ensemble(images, context))
    assert ensemble_of(members[:1]) is members[0]


def test_inputs_are_zero_off_the_mask_on_the_table_and_at_the_median():
    images = torch.from_numpy(synthetic(2)[0].images)
    x = normalise_crops(images)
    outside = images[..., 3] == 0
    assert not x[:, 3][outside].any() and not x[:, 4][outside].any()
    assert x[:, 5][~outside].abs().max() < 0.01
    assert x[:, 0][~outside].max() <= 1.1 and x[:, 0].min() == pytest.approx(-0.9)


def test_round_trip_of_weights(tmp_path):
    torch.manual_seed(0)
    network = CropNet(OUTPUTS["yaw"]).eval()
    save_crop_network(network, tmp_path / "yaw.safetensors", "yaw", 1.3, {"seed": "0"})
    loaded, temperature = load_crop_network("yaw", tmp_path / "yaw.safetensors")
    crops = synthetic(4)[1]
    assert temperature == 1.3
    assert np.allclose(
        predict(network, 1.3, crops.images, crops.context), predict(loaded, 1.3, crops.images, crops.context)
    )
    assert predict(loaded, 1.0, crops.images[:0], crops.context[:0]).shape == (0, YAW_BINS)
    assert (tmp_path / "yaw.safetensors").stat().st_size < 5e6


def test_unusable_weights_are_named_with_a_remedy(tmp_path):
    with pytest.raises(PerceptionError, match=r"are missing; .*nodeslam train detector"):
        load_crop_network("class", tmp_path / "none.safetensors")
    path = tmp_path / "broken.safetensors"
    path.write_bytes(b"\x10\0\0\0")
    with pytest.raises(PerceptionError, match=r"cannot be read .*nodeslam train yaw"):
        load_crop_network("yaw", path)
    save_crop_network(create_network("class"), path, "class", 1.0)
    with pytest.raises(PerceptionError, match="are for 'class', not 'yaw'"):
        load_crop_network("yaw", path)
    save_file({"x": torch.zeros(1)}, path, metadata={"task": "yaw", "temperature": "1.0"})
    with pytest.raises(PerceptionError, match="do not fit the network"):
        load_crop_network("yaw", path)


def test_mirroring_negates_the_yaw():
    labels = torch.from_numpy(soft_labels(np.array([0.3, 2.0, -1.0])))
    expected = torch.from_numpy(soft_labels(np.array([-0.3, -2.0, 1.0])))
    assert torch.allclose(mirror_yaw_bins(labels), expected, atol=1e-6)
    assert torch.equal(mirror_yaw_bins(mirror_yaw_bins(labels)), labels)


class LeftHalf(CropNet):
    """Has the brightness of the left half of the first channel as its first logit."""

    def forward(self, images, context):
        rows = torch.zeros(len(images), self.outputs)
        rows[:, 1] = images[:, 0, :, : SIDE // 2].mean((1, 2))
        return rows


def test_logits_are_averaged_with_those_of_the_mirror_image():
    images, context = torch.zeros(1, 6, SIDE, SIDE), torch.zeros(1, 2)
    images[:, 0, :, : SIDE // 2] = 1.0
    images[:, 0, :, SIDE // 2 :] = 3.0
    classes = mirror_averaged_logits(LeftHalf(5), images, context)
    assert classes[0].tolist() == [0.0, 2.0, 0.0, 0.0, 0.0]
    yaw = mirror_averaged_logits(LeftHalf(YAW_BINS), images, context)[0]
    assert yaw[1] == 0.5 and yaw[-1] == 1.5 and yaw.sum() == 2.0  # bin 1 of the mirror image is bin -1


@pytest.mark.parametrize("temperature", ["nan", "0", "-1", "inf", "hot"])
def test_a_temperature_is_positive(tmp_path, temperature):
    path = tmp_path / "yaw.safetensors"
    save_file(create_network("yaw").state_dict(), path, metadata={"task": "yaw", "temperature": temperature})
    with pytest.raises(PerceptionError, match=f"temperature '{temperature}' is not positive"):
        load_crop_network("yaw", path)


def test_probabilities_are_the_softmax_of_logits_over_the_temperature():
    class Fixed(CropNet):
        def forward(self, images, context):
            return torch.tensor([[1.0, 0.0, 0.0, 0.0, 2.0]]).expand(len(images), -1)

    images = np.zeros((3, SIDE, SIDE, 6), np.uint8)
    found = predict(Fixed(5), 2.0, images, np.zeros((3, 2), np.float32), batch=2)
    weights = np.exp([0.5, 0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(found, np.tile(weights / weights.sum(), (3, 1)), rtol=1e-6)
