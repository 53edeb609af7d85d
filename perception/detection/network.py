"""The small convolutional network behind classes and yaw, and its weights on disk.

One architecture, two tasks: ``detector.safetensors`` answers with the class, ``yaw.safetensors`` with the bin
of the handle's direction relative to the view (both log-probabilities after a softmax). The class is told by
a committee of such networks, which err alike on what cannot be told but not on what one of them missed.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from perception.detection.crops import CHANNELS, CONTEXT, SIDE
from perception.detection.weights import load_weights, save_weights
from perception.detection.yaw import YAW_BINS
from perception.io.weights import WEIGHTS_DIRECTORY
from perception.types import CATEGORIES

Task = Literal["class", "yaw"]
LABELS: tuple[str, ...] = (*CATEGORIES, "other")
OTHER = len(CATEGORIES)
OUTPUTS: dict[Task, int] = {"class": len(LABELS), "yaw": YAW_BINS}
MEMBERS: dict[Task, int] = {"class": 2, "yaw": 1}  # networks that answer together
WEIGHTS_FILES: dict[Task, str] = {"class": "detector.safetensors", "yaw": "yaw.safetensors"}
_WIDTHS = (16, 32, 64, 128)
_SQUEEZED = 48


class CropNet(nn.Module):
    """Four stages of stride two, squeezed, flattened (where things are matters), two layers; 0.4 M weights.

    Args:
        outputs: number of logits.
    """

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.outputs = outputs
        stages = [_convolution(CHANNELS, _WIDTHS[0], stride=2)]  # a second layer at 32 x 32 would cost most
        for narrow, wide in itertools.pairwise(_WIDTHS):
            stages += [_convolution(narrow, wide, stride=2), _convolution(wide, wide, stride=1)]
        squeeze = nn.Sequential(nn.Conv2d(_WIDTHS[-1], _SQUEEZED, 1), nn.ReLU(inplace=True))
        self.features = nn.Sequential(*stages, squeeze)
        flat = _SQUEEZED * (SIDE // 2 ** len(_WIDTHS)) ** 2
        self.head = nn.Sequential(nn.Linear(flat + CONTEXT, 128), nn.ReLU(inplace=True), nn.Dropout(0.2))
        self.logits = nn.Linear(128, outputs)

    def forward(
        self, images: Float[Tensor, "n 6 side side"], context: Float[Tensor, "n 2"]
    ) -> Float[Tensor, "n outputs"]:
        """Logits of prepared crops (``prepared``)."""
        features = self.features(images).flatten(1)  # (n, 48 * 4 * 4)
        return self.logits(self.head(torch.cat([features, context], dim=1)))


class Committee(nn.Module):
    """Networks of one task, trained from different seeds; the mean of their logits counts.

    Args:
        members: one at least.
    """

    def __init__(self, members: Sequence[CropNet]) -> None:
        super().__init__()
        self.outputs = members[0].outputs
        self.members = nn.ModuleList(members)

    def forward(
        self, images: Float[Tensor, "n 6 side side"], context: Float[Tensor, "n 2"]
    ) -> Float[Tensor, "n outputs"]:
        """Logits of prepared crops (``prepared``)."""
        return torch.stack([member(images, context) for member in self.members]).mean(dim=0)


CropNetwork = CropNet | Committee


def untrained(task: Task) -> CropNetwork:
    """What answers for a task: a network, or as many as ``MEMBERS`` says."""
    return together([CropNet(OUTPUTS[task]) for _ in range(MEMBERS[task])])


def together(members: Sequence[CropNet]) -> CropNetwork:
    """One network as it is, several as a committee."""
    return members[0] if len(members) == 1 else Committee(members)


def _convolution(narrow: int, wide: int, stride: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(narrow, wide, 3, stride, 1, bias=False), nn.BatchNorm2d(wide), nn.ReLU(inplace=True)
    )


def prepared(images: UInt8[Tensor, "n side side 6"]) -> Float[Tensor, "n 6 side side"]:
    """Crop images as the network takes them: floats around zero.

    Colours run from -0.9 to 1.1, heights in units of 0.1 m above the plane, depths in 0.1 m off the median.
    """
    scale = torch.tensor([2.0, 2.0, 2.0, 1.0, 3.0, 4.0], device=images.device) / 255.0
    zero = torch.tensor([0.9, 0.9, 0.9, 0.0, 0.0, 2.0], device=images.device)
    x = images.float() * scale - zero
    return x.permute(0, 3, 1, 2)  # channels last in memory, as convolutions like it


def logits_both_ways(
    network: CropNetwork, images: Float[Tensor, "n 6 side side"], context: Float[Tensor, "n 2"]
) -> Float[Tensor, "n outputs"]:
    """Mean of the logits of prepared crops and of their mirror images, whose yaws have the other sign."""
    seen, mirrored = network(images, context), network(images.flip(3), context)
    if mirrored.shape[1] == YAW_BINS:
        mirrored = mirrored_bins(mirrored)
    return (seen + mirrored) / 2


def mirrored_bins(rows: Float[Tensor, "n bins"]) -> Float[Tensor, "n bins"]:
    """Bin k becomes bin -k."""
    return rows.roll(-1, 1).flip(1)


def save_network(
    network: CropNetwork, path: Path, task: Task, temperature: float, notes: dict[str, str] | None = None
) -> None:
    """Write weights and what is needed to use them to a safetensors file.

    Args:
        temperature: divides the logits so that probabilities are calibrated.
        notes: further metadata, such as how it was trained.
    """
    about = {**(notes or {}), "task": task, "temperature": repr(float(temperature))}
    about |= {"outputs": str(OUTPUTS[task]), "labels": json.dumps(LABELS if task == "class" else [])}
    save_weights({name: value.detach().cpu() for name, value in network.state_dict().items()}, path, about)


def load_network(
    task: Task, path: Path | None = None, device: str | torch.device = "cpu"
) -> tuple[CropNetwork, float]:
    """(network in evaluation mode, its temperature), by default the shipped weights.

    Raises:
        PerceptionError: the file is missing, damaged, or holds another network.
    """
    path = WEIGHTS_DIRECTORY / WEIGHTS_FILES[task] if path is None else path
    network = untrained(task)
    about = load_weights(network, path, task, "detector" if task == "class" else "yaw")
    return network.to(device).eval(), float(about.get("temperature", 1.0))


@torch.inference_mode()
def predict(
    network: CropNetwork,
    temperature: float,
    images: UInt8[np.ndarray, "n side side 6"],
    context: Float[np.ndarray, "n 2"],
    batch: int = 256,
) -> Float[np.ndarray, "n outputs"]:
    """Calibrated probabilities of crops, each seen as it is and mirrored."""
    device = next(network.parameters()).device
    rows = []
    for start in range(0, len(images), batch):
        x = prepared(torch.from_numpy(images[start : start + batch]).to(device))
        logits = logits_both_ways(network, x, torch.from_numpy(context[start : start + batch]).to(device))
        rows.append(functional.softmax(logits.double() / temperature, dim=1).cpu().numpy())
    return np.concatenate(rows) if rows else np.zeros((0, network.outputs))
