"""Training on several processes that share every batch, with PyTorch's DistributedDataParallel.

Each process ("rank") draws the order and the random numbers of the whole batch, and takes its share of the
rows. Losses are weighted by the rows, so that the average of the gradients over the ranks is the gradient of
the whole batch, also for shares of different sizes. Batch normalisation uses the statistics of the whole
batch: ``torch.nn.SyncBatchNorm`` does so on CUDA only, ``SharedBatchNorm2d`` with any backend. One process
alone computes what it would without this module, bit by bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.parallel import DistributedDataParallel

# The other ranks wait while the first evaluates; the process that started them notices when one dies.
_PATIENCE = timedelta(days=30)


@dataclass(frozen=True)
class Ranks:
    """The processes of a training, seen from one of them.

    Attributes:
        rank: Number of this process, from 0.
        count: Number of processes.
    """

    rank: int = 0
    count: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and reports progress."""
        return self.rank == 0

    def share(self, whole: int) -> slice:
        """Return the rows of this process in a batch of ``whole`` rows; shares differ by at most one row."""
        return slice(whole * self.rank // self.count, whole * (self.rank + 1) // self.count)

    def parallel(self, network: nn.Module) -> nn.Module:
        """Return the network for forward passes in training: itself, or DistributedDataParallel around it.

        Batch normalisation and dropout layers of several ranks are replaced, in place, by those that act on
        the whole batch; parameters, buffers and their names stay.
        """
        if self.count == 1:
            return network
        _share_layers(network, self)
        return DistributedDataParallel(network, forward_sync_buffers=False)  # they are equal

    def weighted(self, mean: Float[Tensor, ""], rows: int, whole: int) -> Float[Tensor, ""]:
        """Return the mean loss of a share, scaled so that its mean over the ranks is that of the batch.

        Args:
            mean: Mean loss of the share's rows; without rows any number that depends on all parameters.
            rows: Number of rows in the share.
            whole: Number of rows in the batch.
        """
        return mean * (self.count * rows / whole)

    def total(self, value: Tensor) -> Tensor:
        """Return the sum over the ranks, without gradient."""
        if self.count == 1:
            return value
        result = value.detach().clone()
        dist.all_reduce(result)
        return result


@contextmanager
def process_group(ranks: Ranks, device: str, store: Path) -> Iterator[None]:
    """Join the group of processes: NCCL with one GPU for each on CUDA, gloo on the CPU.

    Args:
        ranks: This process and the number of all.
        device: "cpu" or "cuda", which then stands for the GPU of this process.
        store: File by which the processes find each other; absent at first.
    """
    if device == "cuda":
        torch.cuda.set_device(ranks.rank)
    dist.init_process_group(
        "nccl" if device == "cuda" else "gloo",
        init_method=f"file://{store}",
        rank=ranks.rank,
        world_size=ranks.count,
        timeout=_PATIENCE,
    )
    yield
    dist.destroy_process_group()  # not after an error: it could wait for a rank that is gone


def random_state(device: str) -> UInt8[np.ndarray, "n"]:
    """Return the state of the random numbers that layers draw on a device, such as dropout."""
    return (torch.cuda.get_rng_state() if device == "cuda" else torch.get_rng_state()).numpy()


def set_random_state(device: str, state: UInt8[np.ndarray, "n"]) -> None:
    """Restore a state of ``random_state``."""
    if device == "cuda":
        torch.cuda.set_rng_state(torch.from_numpy(state))
    else:
        torch.set_rng_state(torch.from_numpy(state))


class SharedBatchNorm2d(nn.BatchNorm2d):
    """Batch normalisation with mean and variance over the shares of all ranks, in float32 at least."""

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        if not self.training:
            return super().forward(x)
        values = x.to(torch.promote_types(x.dtype, torch.float32))
        rows = values.new_tensor([float(values.numel() // self.num_features)])
        sums = _sum_over_ranks(torch.cat([values.sum((0, 2, 3)), rows]))
        count = sums[-1].detach()
        mean = sums[:-1] / count
        centred = values - mean[:, None, None]
        variance = _sum_over_ranks(centred.square().sum((0, 2, 3))) / count
        self._track(mean.detach(), variance.detach() * (count / (count - 1)))
        factor = self.weight / torch.sqrt(variance + self.eps)
        return (centred * factor[:, None, None] + self.bias[:, None, None]).to(x.dtype)

    def _track(self, mean: Float[Tensor, "c"], variance: Float[Tensor, "c"]) -> None:
        """Update the running statistics as ``nn.BatchNorm2d`` does."""
        assert self.running_mean is not None and self.running_var is not None
        assert self.num_batches_tracked is not None and self.momentum is not None
        with torch.no_grad():
            self.num_batches_tracked.add_(1)
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance, self.momentum)


class SharedDropout(nn.Dropout):
    """Dropout with the rows of this rank of a mask that is drawn for the whole batch."""

    def __init__(self, p: float, ranks: Ranks) -> None:
        super().__init__(p)
        self._ranks = ranks

    def forward(self, x: Float[Tensor, "n *rest"]) -> Float[Tensor, "n *rest"]:
        if not self.training:
            return x
        whole = int(self._ranks.total(torch.tensor(len(x), device=x.device)))
        ones = torch.ones(whole, *x.shape[1:], dtype=x.dtype, device=x.device)
        return x * functional.dropout(ones, self.p)[self._ranks.share(whole)]


def _share_layers(network: nn.Module, ranks: Ranks) -> None:
    """Replace the layers whose result depends on the other rows of the batch, or on random numbers."""
    for parent in list(network.modules()):
        for name, layer in list(parent.named_children()):
            if isinstance(layer, nn.BatchNorm2d):
                shared = SharedBatchNorm2d(layer.num_features, layer.eps, layer.momentum)
                for own in ("weight", "bias", "running_mean", "running_var", "num_batches_tracked"):
                    setattr(shared, own, getattr(layer, own))  # the optimiser has these parameters
                setattr(parent, name, shared)
            elif isinstance(layer, nn.Dropout):
                setattr(parent, name, SharedDropout(layer.p, ranks))


class _SumOverRanks(torch.autograd.Function):
    """Sum over the ranks; its derivative is the sum of their derivatives."""

    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        result = value.clone()
        dist.all_reduce(result)
        return result

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        result = gradient.clone(memory_format=torch.contiguous_format)
        dist.all_reduce(result)
        return result


def _sum_over_ranks(value: Tensor) -> Tensor:
    result = _SumOverRanks.apply(value)
    assert isinstance(result, Tensor)
    return result
