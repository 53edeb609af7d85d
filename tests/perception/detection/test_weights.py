"""Weights files of the detection networks: metadata, tasks, damaged files."""

import pytest
import torch
from torch import nn

from perception.detection.weights import load_weights, save_weights, temperature_of
from perception.errors import PerceptionError


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "new" / "w.safetensors"
    network = nn.Linear(2, 1)
    save_weights(network.state_dict(), path, {"task": "class", "temperature": "1.5"})
    return network, path


def test_round_trip_returns_the_metadata(saved):
    network, path = saved
    loaded = nn.Linear(2, 1)
    assert load_weights(loaded, path, "class", "detector") == {"task": "class", "temperature": "1.5"}
    assert torch.equal(loaded.weight, network.weight) and torch.equal(loaded.bias, network.bias)


def test_another_task_or_another_network_is_refused(saved):
    _, path = saved
    with pytest.raises(PerceptionError, match=r"are for 'class', not 'yaw'; .*nodeslam train yaw"):
        load_weights(nn.Linear(2, 1), path, "yaw", "yaw")
    with pytest.raises(PerceptionError, match=r"do not fit .*weight.*nodeslam train detector"):
        load_weights(nn.Linear(3, 1), path, "class", "detector")


def test_missing_and_damaged_files_are_named(saved):
    _, path = saved
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(PerceptionError, match=r"w\.safetensors cannot be read"):
        load_weights(nn.Linear(2, 1), path, "class", "detector")
    path.unlink()
    with pytest.raises(
        PerceptionError, match=r"w\.safetensors are missing; reinstall the package, or retrain"
    ):
        load_weights(nn.Linear(2, 1), path, "class", "detector")


def test_temperatures_are_positive_numbers(tmp_path):
    assert temperature_of({"temperature": "1.5"}, tmp_path) == 1.5 and temperature_of({}, tmp_path) == 1.0
    for wrong in ("0", "-1.0", "nan", "inf", "warm"):
        with pytest.raises(PerceptionError, match=rf"temperature '{wrong}' is not positive"):
            temperature_of({"temperature": wrong}, tmp_path)
