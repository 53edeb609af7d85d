"""Shares of batches, layers, gradients and whole trainings of two processes against those of one."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from app.training.processes import run_on_ranks
from perception.detection import crop_training, scene_training
from perception.detection.crop_training import (
    CropSet,
    TrainingConfig,
    TrainingData,
    TrainingJob,
    train_crop_network,
)
from perception.detection.scene_network import SceneNet
from perception.detection.scene_patches import LabelledScene, sample_patch
from perception.detection.scene_training import SceneTrainingConfig, train_scene_network
from perception.detection.tasks import OUTPUTS, Task
from perception.distributed import Ranks, SharedBatchNorm2d, random_state, set_random_state
from perception.shape.dataset import ShapeDataset
from perception.shape.training import ShapeTrainingConfig, train
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane

WHOLE = 5  # rows of the batch: shares of two and three


def network():
    torch.manual_seed(1)
    layers = [nn.Conv2d(3, 4, 3, bias=False), nn.BatchNorm2d(4), nn.ReLU(), nn.Flatten(), nn.Dropout(0.4)]
    return nn.Sequential(*layers, nn.Linear(4 * 36, 2))


def fit(ranks: Ranks, whole: int = WHOLE):
    """Return parameters, buffers and the loss after three steps of gradient descent on squared errors."""
    net = network()
    optimizer = torch.optim.SGD(net.parameters(), 0.05)
    parallel = ranks.parallel(net)
    rng = np.random.default_rng(0)
    torch.manual_seed(2)
    losses = []
    for _ in range(3):
        x = torch.from_numpy(rng.normal(1.0, 3.0, (whole, 3, 8, 8)).astype(np.float32))
        y = torch.from_numpy(rng.normal(size=(whole, 2)).astype(np.float32))
        share = ranks.share(whole)
        x, y = x[share], y[share]
        output = parallel(x)
        mean = (output - y).square().sum(1).mean() if len(x) else output.sum()
        loss = ranks.weighted(mean, len(x), whole)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(ranks.total(loss.detach())) / ranks.count)
    return {**net.state_dict(), "losses": torch.tensor(losses)}


def fit_and_save(folder: Path, ranks: Ranks, report) -> None:
    # A batch of one row leaves one process without rows.
    torch.save([fit(ranks), fit(ranks, whole=1)], folder / f"rank{ranks.rank}.pt")
    report(ranks.rank, float(ranks.total(torch.tensor(ranks.rank + 1.0))))


@pytest.mark.parametrize("whole", [0, 1, 2, 7, 128])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_shares_are_a_partition_and_differ_by_at_most_one_row(whole, count):
    rows = [np.arange(whole)[Ranks(rank, count).share(whole)] for rank in range(count)]
    assert np.concatenate(rows).tolist() == list(range(whole))
    assert max(map(len, rows)) - min(map(len, rows)) <= 1


def test_one_process_keeps_its_network_and_its_losses():
    net, ranks = network(), Ranks()
    assert ranks.parallel(net) is net and ranks.is_first and not Ranks(1, 2).is_first
    assert not any(isinstance(layer, SharedBatchNorm2d) for layer in net.modules())
    value = torch.tensor(0.1)
    assert ranks.total(value) is value and torch.equal(ranks.weighted(value, 3, 3), value)


def test_losses_of_uneven_shares_average_to_the_mean_of_the_batch():
    rows = torch.tensor([1.0, 5.0, 9.0, 2.0, 7.0])
    parts = []
    for rank in range(2):
        share = rows[Ranks(rank, 2).share(5)]
        parts.append(Ranks(rank, 2).weighted(share.mean(), len(share), 5))
    assert torch.stack(parts).mean() == pytest.approx(float(rows.mean()))


def test_two_processes_take_the_same_steps_as_one(tmp_path):
    reports = []
    run_on_ranks(fit_and_save, tmp_path, 2, "cpu", lambda *message: reports.append(message))
    assert sorted(reports) == [(0, 3.0), (1, 3.0)]
    found = [torch.load(tmp_path / f"rank{rank}.pt") for rank in range(2)]
    for k, whole in enumerate((WHOLE, 1)):
        alone = fit(Ranks(), whole)
        assert not torch.equal(alone["0.weight"], network().state_dict()["0.weight"])
        for name, value in alone.items():
            torch.testing.assert_close(found[0][k][name], value, rtol=1e-4, atol=2e-5, msg=name)
            if name != "losses":
                assert torch.equal(found[0][k][name], found[1][k][name]), name


def test_random_states_of_layers_are_restored():
    before = random_state("cpu")
    first = torch.rand(3)
    set_random_state("cpu", before)
    assert torch.equal(torch.rand(3), first)


def crops_of(task: Task, count: int) -> CropSet:
    rng = np.random.default_rng(count)
    images = rng.integers(0, 255, (count, 64, 64, 6), dtype=np.uint8)
    targets = np.eye(OUTPUTS[task], dtype=np.float32)[rng.integers(OUTPUTS[task], size=count)]
    return CropSet(images, rng.random((count, 2)), targets)


def scene_of(number: int) -> LabelledScene:
    """Return a picture of a flat table from above with one square object."""
    rng = np.random.default_rng(number)
    T_world_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    T_world_camera[2, 3] = 0.6
    things = np.zeros((64, 64), np.uint8)
    things[10 + number : 30, 20:44] = 1
    camera = CameraIntrinsics(64, 64, 70.0, 70.0, 31.5, 31.5)
    rgb, depth = rng.integers(0, 255, (64, 64, 3), dtype=np.uint8), np.full((64, 64), 0.55, np.float32)
    frame = RgbdFrame(0.0, rgb, depth, camera, T_world_camera)
    plane = SupportPlane(np.array([0.0, 0.0, 1.0]), 0.0)
    return LabelledScene(frame, things, np.array([number]), np.zeros((1, 3)), plane)


def shapes() -> ShapeDataset:
    grids = np.random.default_rng(0).integers(0, 255, (5, 32, 32, 32), dtype=np.uint8)
    return ShapeDataset(grids, np.array([0, 1, 2, 3, 0]))


def double_scene_network(ranks: Ranks) -> SceneNet:
    """Return the scene network with the gradients of a batch as weights, computed in float64.

    In float32 its normalisations of few pixels amplify rounding as much as those of few crops.
    """
    torch.manual_seed(3)
    net = SceneNet().double()
    rng = np.random.default_rng(4)
    patches = [sample_patch(scene_of(k), 64, rng) for k in range(3)]
    patches = [replace(patch, channels=patch.channels.astype(np.float64)) for patch in patches]
    parallel = ranks.parallel(net)  # averages gradients as long as it lives
    losses = scene_training._step(parallel, patches, SceneTrainingConfig(), ranks)
    (ranks.count * losses.sum()).backward()
    for parameter in net.parameters():
        assert parameter.grad is not None
        parameter.data = parameter.grad
    return net


@contextmanager
def doubled() -> Iterator[None]:
    """Train crop networks in float64.

    In float32 their normalisations of seven crops amplify rounding, which depends on the processor, to 0.2.
    """
    normalise = crop_training.normalise_crops
    crop_training.normalise_crops = lambda images: normalise(images).double()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)
        crop_training.normalise_crops = normalise


def train_all(folder: Path, ranks: Ranks, report=None) -> None:
    """Train every kind of network for a few steps, on batches of odd sizes, and save their weights."""
    capabilities, torch.cpu.get_capabilities = torch.cpu.get_capabilities, dict  # none: in full precision
    own = folder / f"rank{ranks.rank}"
    own.mkdir()
    job = TrainingJob(own, progress=report, ranks=ranks)
    found = {}
    try:
        with doubled():
            for task in ("class", "pose", "yaw"):
                data = TrainingData(crops_of(task, 7), crops_of(task, 2))
                found[task] = train_crop_network(task, data, TrainingConfig(epochs=1, batch=7), job)
        found["scene"] = train_scene_network(
            scene_of, 3, SceneTrainingConfig(epochs=1, batch=3, side=64), job
        )
        config = ShapeTrainingConfig(epochs=1, batch_size=3, warmup_steps=2)
        on_epoch = None if report is None else lambda record, model: report(record)
        found["shape"] = train(
            shapes(), config, checkpoint=own / "checkpoint.pt", on_epoch=on_epoch, ranks=ranks
        )
        found["scene, double"] = double_scene_network(ranks)
    finally:
        torch.cpu.get_capabilities = capabilities
    torch.save({name: net.state_dict() for name, net in found.items()}, folder / f"rank{ranks.rank}.pt")


CHECKPOINTS = {"shape": "checkpoint.pt"}


def gradients(folder: Path, name: str) -> torch.Tensor:
    """Return the running mean of the gradients of a training, from the first process's checkpoint."""
    checkpoint = torch.load(folder / "rank0" / CHECKPOINTS.get(name, f"checkpoint_{name}.pt"))
    return torch.cat([state["exp_avg"].flatten() for state in checkpoint["optimizer"]["state"].values()])


def joined(weights: dict[str, torch.Tensor]) -> torch.Tensor:
    return torch.cat([w.flatten().double() for k, w in weights.items() if "num_batches" not in k])


def difference(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found - expected).norm() / expected.norm())


def test_trainings_on_two_processes_equal_those_on_one(tmp_path):
    both, one, reports, expected = tmp_path / "both", tmp_path / "one", [], []
    both.mkdir()
    one.mkdir()
    torch.manual_seed(9)  # dropout
    state = random_state("cpu")
    run_on_ranks(train_all, both, 2, "cpu", lambda *message: reports.append(message))
    after = random_state("cpu")
    set_random_state("cpu", state)
    train_all(one, Ranks(), lambda *message: expected.append(message))
    first, second, alone = (torch.load(f) for f in (both / "rank0.pt", both / "rank1.pt", one / "rank0.pt"))
    for name, weights in alone.items():
        for key in weights:
            assert torch.equal(first[name][key], second[name][key]), (name, key)
        if name == "scene, double":
            assert difference(joined(first[name]), joined(weights)) < 1e-5, name
        else:
            limit = 0.4 if name == "scene" else 1e-4
            assert difference(gradients(both, name), gradients(one, name)) < limit, name
            assert difference(joined(first[name]), joined(weights)) < 0.02, name

    assert [file.name for file in (both / "rank1").iterdir()] == []  # the first process writes
    assert torch.equal(torch.from_numpy(after), torch.from_numpy(random_state("cpu")))
    for message, same in zip(reports, expected, strict=True):
        assert message[:2] == same[:2] if len(same) > 1 else message[0].epoch == same[0].epoch
        found, losses = (m[2] if len(m) > 1 else {"loss": m[0].loss} for m in (message, same))
        assert found == pytest.approx(losses, rel=0.01)
