"""The dense network for instance segmentation: foreground, class and a Hough vote for every pixel.

Every foreground pixel votes for its object's footprint: the point where the object's axis meets the support
plane. The vote is an offset along the image's axes in the plane (``working_view``), in units of the pixel's
metric size, with a predicted standard error. Votes of one object coincide; the footprints of objects in
contact are still apart.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from perception.detection.architecture import SCENE_JOINED, SCENE_WIDTHS
from perception.detection.tasks import SCENE_OUTPUTS, SCENE_WEIGHTS_FILE
from perception.detection.weights import load_weights, save_weights
from perception.detection.working_view import CHANNELS
from perception.io.weights import WEIGHTS_DIRECTORY


class SceneNet(nn.Module):
    """Encoder-decoder with skip connections between 1/2 and 1/32 of the resolution; 1.7 M weights."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d, e = SCENE_WIDTHS
        fine, middle, coarse = SCENE_JOINED
        self.down = nn.ModuleList([
            _convolution(4 * CHANNELS, a),
            nn.Sequential(_convolution(a, b, 2), _convolution(b, b)),
            nn.Sequential(_convolution(b, c, 2), _Residual(c), _Residual(c)),
            nn.Sequential(_convolution(c, d, 2), _Residual(d), _Residual(d)),
            nn.Sequential(_convolution(d, e, 2), _Residual(e)),
        ])  # fmt: skip
        self.across = nn.ModuleList(
            _lateral(wide, narrow)
            for wide, narrow in zip(SCENE_WIDTHS, (fine, middle, coarse, coarse, coarse))
        )
        self.narrower = nn.ModuleList([nn.Conv2d(middle, fine, 1), nn.Conv2d(coarse, middle, 1)])
        self.joined = nn.ModuleList(_convolution(n, n) for n in (fine, middle, coarse))
        self.answer = nn.Conv2d(fine, SCENE_OUTPUTS, 1)

    def forward(self, channels: Float[Tensor, "n 8 h w"]) -> Float[Tensor, "n 12 h2 w2"]:
        """Return the outputs at half the resolution; height and width must be even."""
        x = functional.pixel_unshuffle(channels, 2)
        levels = []
        for stage in self.down:
            x = stage(x)
            levels.append(x)
        x = self.across[4](levels[4])
        x = self.across[3](levels[3]) + _resized(x, levels[3])
        x = self.joined[2](self.across[2](levels[2]) + _resized(x, levels[2]))
        x = self.joined[1](self.across[1](levels[1]) + _resized(self.narrower[1](x), levels[1]))
        x = self.joined[0](self.across[0](levels[0]) + _resized(self.narrower[0](x), levels[0]))
        return self.answer(x)


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = _convolution(width, width)
        self.second = nn.Sequential(nn.Conv2d(width, width, 3, 1, 1, bias=False), nn.BatchNorm2d(width))

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.second(self.first(x)))


def _convolution(narrow: int, wide: int, stride: int = 1) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(narrow, wide, 3, stride, 1, bias=False), nn.BatchNorm2d(wide), nn.ReLU(inplace=True)
    )


def _lateral(wide: int, narrow: int) -> nn.Module:
    return nn.Sequential(nn.Conv2d(wide, narrow, 1, bias=False), nn.BatchNorm2d(narrow))


def _resized(x: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(x, size=like.shape[-2:], mode="bilinear", align_corners=False)


@torch.inference_mode()
def predict_scene(network: SceneNet, channels: Float[np.ndarray, "h w 8"]) -> Float[np.ndarray, "h2 w2 12"]:
    """Return the network's outputs for one view; an odd last row or column is repeated."""
    device = next(network.parameters()).device
    padded = np.pad(channels, ((0, channels.shape[0] % 2), (0, channels.shape[1] % 2), (0, 0)), mode="edge")
    x = torch.from_numpy(padded).to(device).permute(2, 0, 1)[None]  # channels last in memory
    return network(x)[0].permute(1, 2, 0).float().cpu().numpy()


def save_scene_network(network: SceneNet, path: Path, notes: dict[str, str] | None = None) -> None:
    """Write the weights in half precision with metadata ``notes``, such as the training configuration."""
    tensors = {
        name: value.detach().cpu().half() if value.is_floating_point() else value.detach().cpu()
        for name, value in network.state_dict().items()
    }
    save_weights(tensors, path, {**(notes or {}), "task": "scene"})


def load_scene_network(path: Path | None = None, device: str | torch.device = "cpu") -> SceneNet:
    """Return the network for inference, with batch normalisation folded into the convolutions.

    Args:
        path: Weights file; the shipped one if None.
        device: Where the network runs.

    Raises:
        PerceptionError: The file is missing, damaged, differs from its checksum, or is of another network.
    """
    network = SceneNet()
    load_weights(
        network, WEIGHTS_DIRECTORY / SCENE_WEIGHTS_FILE if path is None else path, "scene", "detector"
    )
    network = _folded(network.eval()).to(device)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network


def _folded(network: SceneNet) -> SceneNet:
    """Fold each batch normalisation into the convolution before it, in place."""
    for module in list(network.modules()):
        if not isinstance(module, nn.Sequential) or len(module) < 2:
            continue
        convolution, normalisation = module[0], module[1]
        if isinstance(convolution, nn.Conv2d) and isinstance(normalisation, nn.BatchNorm2d):
            module[0] = fuse_conv_bn_eval(convolution, normalisation)
            module[1] = nn.Identity()
    return network
