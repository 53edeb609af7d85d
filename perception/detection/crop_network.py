"""The convolutional network on crops for classes, poses and directions, ensembles of it, and weights files.

One architecture, four tasks: ``detector.safetensors`` predicts the class of upright objects,
``pose.safetensors`` class and resting pose of any, ``yaw.safetensors`` the bin of the handle's yaw relative
to the view, ``axis.safetensors`` that of the axis of what lies. A task may have an ensemble
(Lakshminarayanan et al., "Simple and scalable predictive uncertainty estimation using deep ensembles",
2017), whose logits are averaged.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from perception.detection.architecture import CROP_SIZES
from perception.detection.crops import CHANNELS, CONTEXT, SIDE
from perception.detection.tasks import (
    ENSEMBLE_SIZE,
    LABELS,
    OUTPUTS,
    POSE_LABELS,
    TRAINED_BY,
    WEIGHTS_FILES,
    Task,
)
from perception.detection.weights import load_weights, save_weights, temperature_of
from perception.detection.yaw import YAW_BINS
from perception.io.weights import WEIGHTS_DIRECTORY

_NAMES: dict[Task, tuple[str, ...]] = {"class": LABELS, "pose": POSE_LABELS, "yaw": (), "axis": ()}


class CropNet(nn.Module):
    """Four convolution stages of stride two, a 1 x 1 bottleneck, two linear layers.

    Features are flattened instead of pooled: their position in the upright crop carries information.

    Args:
        outputs: Number of logits.
    """

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.outputs = outputs
        widths = CROP_SIZES.widths
        stages = [_convolution(CHANNELS, widths[0], stride=2)]  # a second layer at 32 x 32 would cost most
        for narrow, wide in itertools.pairwise(widths):
            stages += [_convolution(narrow, wide, stride=2), _convolution(wide, wide, stride=1)]
        squeeze = nn.Sequential(nn.Conv2d(widths[-1], CROP_SIZES.squeezed, 1), nn.ReLU(inplace=True))
        self.features = nn.Sequential(*stages, squeeze)
        flat = CROP_SIZES.squeezed * (SIDE // 2 ** len(widths)) ** 2
        self.head = nn.Sequential(
            nn.Linear(flat + CONTEXT, CROP_SIZES.hidden), nn.ReLU(inplace=True), nn.Dropout(0.2)
        )
        self.logits = nn.Linear(CROP_SIZES.hidden, outputs)

    def forward(
        self, images: Float[Tensor, "n 6 side side"], context: Float[Tensor, "n 2"]
    ) -> Float[Tensor, "n outputs"]:
        """Return the logits of crops normalised by ``normalise_crops``."""
        features = self.features(images).flatten(1)
        return self.logits(self.head(torch.cat([features, context], dim=1)))


class Ensemble(nn.Module):
    """Networks of one task trained from different seeds, whose logits are averaged.

    Args:
        members: At least one network.
    """

    def __init__(self, members: Sequence[CropNet]) -> None:
        super().__init__()
        self.outputs = members[0].outputs
        self.members = nn.ModuleList(members)

    def forward(
        self, images: Float[Tensor, "n 6 side side"], context: Float[Tensor, "n 2"]
    ) -> Float[Tensor, "n outputs"]:
        """Return the logits of crops normalised by ``normalise_crops``."""
        return torch.stack([member(images, context) for member in self.members]).mean(dim=0)


CropNetwork = CropNet | Ensemble


def create_network(task: Task) -> CropNetwork:
    """Return an untrained network for a task, or an ensemble of ``ENSEMBLE_SIZE`` networks."""
    return ensemble_of([create_member(task) for _ in range(ENSEMBLE_SIZE[task])])


def create_member(task: Task) -> CropNet:
    """Return an untrained network for a task, one of its ensemble."""
    return CropNet(OUTPUTS[task])


def ensemble_of(members: Sequence[CropNet]) -> CropNetwork:
    """Return the network itself if there is one, an ensemble of several."""
    return members[0] if len(members) == 1 else Ensemble(members)


def members_of(network: CropNetwork) -> list[CropNet]:
    """Return the networks of an ensemble, or the network itself."""
    return [cast(CropNet, m) for m in network.members] if isinstance(network, Ensemble) else [network]


def _convolution(narrow: int, wide: int, stride: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(narrow, wide, 3, stride, 1, bias=False), nn.BatchNorm2d(wide), nn.ReLU(inplace=True)
    )


def normalise_crops(images: UInt8[Tensor, "n side side 6"]) -> Float[Tensor, "n 6 side side"]:
    """Return crop images as the network's input: floats around zero, channels first.

    Colours range from -0.9 to 1.1; heights above the plane and depths relative to the median are in
    decimetres.
    """
    scale = torch.tensor([2.0, 2.0, 2.0, 1.0, 3.0, 4.0], device=images.device) / 255.0
    zero = torch.tensor([0.9, 0.9, 0.9, 0.0, 0.0, 2.0], device=images.device)
    x = images.float() * scale - zero
    return x.permute(0, 3, 1, 2)  # channels last in memory: faster convolutions


def mirror_averaged_logits(
    network: CropNetwork, images: Float[Tensor, "n 6 side side"], context: Float[Tensor, "n 2"]
) -> Float[Tensor, "n outputs"]:
    """Return the mean of the logits of normalised crops and of their mirror images.

    Yaw changes its sign in a mirror image, so its bins are mirrored back before averaging.
    """
    original, mirrored = network(images, context), network(images.flip(3), context)
    if mirrored.shape[1] == YAW_BINS:
        mirrored = mirror_yaw_bins(mirrored)
    return (original + mirrored) / 2


def mirror_yaw_bins(rows: Float[Tensor, "n bins"]) -> Float[Tensor, "n bins"]:
    """Move bin k to bin -k (modulo the number of bins)."""
    return rows.roll(-1, 1).flip(1)


def save_crop_network(
    network: CropNetwork, path: Path, task: Task, temperature: float, notes: dict[str, str] | None = None
) -> None:
    """Write weights, task and temperature to a safetensors file.

    Args:
        network: Network or ensemble of the task.
        path: File to write.
        task: What the network predicts.
        temperature: Divisor of the logits that calibrates the probabilities.
        notes: Further metadata, such as the training configuration.
    """
    about = {**(notes or {}), "task": task, "temperature": repr(float(temperature))}
    about |= {"outputs": str(OUTPUTS[task]), "labels": json.dumps(_NAMES[task])}
    save_weights({name: value.detach().cpu() for name, value in network.state_dict().items()}, path, about)


def load_crop_network(
    task: Task, path: Path | None = None, device: str | torch.device = "cpu"
) -> tuple[CropNetwork, float]:
    """Return (network in evaluation mode, its temperature).

    Args:
        task: What the network predicts.
        path: Weights file; the shipped one if None.
        device: Where the network runs.

    Raises:
        PerceptionError: The file is missing, damaged, differs from its checksum, or is of another network.
    """
    path = WEIGHTS_DIRECTORY / WEIGHTS_FILES[task] if path is None else path
    network = create_network(task)
    temperature = temperature_of(load_weights(network, path, task, TRAINED_BY[task]), path)
    return network.to(device).eval(), temperature


@torch.inference_mode()
def predict(
    network: CropNetwork,
    temperature: float,
    images: UInt8[np.ndarray, "n side side 6"],
    context: Float[np.ndarray, "n 2"],
    batch: int = 256,
) -> Float[np.ndarray, "n outputs"]:
    """Return calibrated probabilities of crops, averaged in log space with their mirror images.

    Args:
        network: Network or ensemble in evaluation mode.
        temperature: Divisor of the logits.
        images: Crop images (``crops.Crop.image``).
        context: Scale and elevation of each crop (``crops.Crop.context``).
        batch: Number of crops per forward pass.
    """
    device = next(network.parameters()).device
    rows = []
    for start in range(0, len(images), batch):
        x = normalise_crops(torch.from_numpy(images[start : start + batch]).to(device))
        logits = mirror_averaged_logits(
            network, x, torch.from_numpy(context[start : start + batch]).to(device)
        )
        rows.append(functional.softmax(logits.double() / temperature, dim=1).cpu().numpy())
    return np.concatenate(rows) if rows else np.zeros((0, network.outputs))
