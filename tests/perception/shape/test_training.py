"""Training reduces the loss, resumes bit by bit and rejects checkpoints of other runs."""

from copy import deepcopy

import numpy as np
import pytest
import torch

from perception.errors import InvalidInputError, PerceptionError
from perception.shape.dataset import ShapeDataset, occupancies
from perception.shape.losses import LossConfig, shape_loss, voxel_weights
from perception.shape.network import class_one_hot
from perception.shape.training import (
    EpochRecord,
    ShapeTrainingConfig,
    TrainingRun,
    learning_rate,
    train,
    train_epoch,
)
from perception.types import CATEGORIES

AXIS = np.arange(32) - 15.5
X, Y, Z = np.meshgrid(AXIS, AXIS, AXIS, indexing="ij")
MUG, CAN = CATEGORIES.index("mug"), CATEGORIES.index("can")


def cylinder(radius: float, x: float = 0.0) -> np.ndarray:
    return (np.hypot(X - x, Y) < radius) & (abs(Z) < 13)


def mug(radius: float) -> np.ndarray:
    """A body standing left of the middle with a bar, three voxels thick, as its handle."""
    body = cylinder(radius, x=-4) & ~(cylinder(radius - 2, x=-4) & (Z > -11))
    return body | ((-4 + radius < X) & (X < 13) & (abs(Y) < 2) & (abs(Z) < 2))


@pytest.fixture(scope="module")
def shapes() -> ShapeDataset:
    radii = np.linspace(6, 10, 16)  # [voxel]
    grids = {"mug": [mug(radius) for radius in radii], "can": [cylinder(radius) for radius in radii]}
    return ShapeDataset.from_grids({name: np.array(value, np.float32) for name, value in grids.items()})


CONFIG = ShapeTrainingConfig(epochs=3, batch_size=4, warmup_steps=4, seed=7)


def test_training_on_32_shapes_reduces_the_loss(shapes):
    records: list[EpochRecord] = []
    batches = []
    train(
        shapes,
        ShapeTrainingConfig(epochs=4, batch_size=4, learning_rate=4e-3, warmup_steps=4),
        on_epoch=lambda record, model: records.append(record),
        on_batch=lambda *counts: batches.append(counts),
    )
    assert [record.epoch for record in records] == [1, 2, 3, 4]
    assert records[-1].loss < 0.85 * records[0].loss
    assert batches[0] == (1, 1, 8)
    assert batches[-1] == (4, 8, 8)


def test_a_resumed_run_equals_an_uninterrupted_one(shapes, tmp_path):
    shapes = ShapeDataset(shapes.grids[::4], shapes.categories[::4])
    whole = train(shapes, CONFIG)

    def interrupt(epoch: int, done: int, batches: int) -> None:
        if (epoch, done) == (2, 1):
            raise KeyboardInterrupt

    checkpoint = tmp_path / "run" / "checkpoint.pt"
    with pytest.raises(KeyboardInterrupt):
        train(shapes, CONFIG, checkpoint=checkpoint, on_batch=interrupt)
    epochs = []
    resumed = train(shapes, CONFIG, checkpoint=checkpoint, on_epoch=lambda r, _: epochs.append(r.epoch))
    assert epochs == [2, 3]
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    assert [path.name for path in checkpoint.parent.iterdir()] == ["checkpoint.pt"]


def test_checkpoints_of_other_configurations_and_damaged_ones_are_rejected(shapes, tmp_path):
    checkpoint = tmp_path / "checkpoint.pt"
    few = ShapeDataset(shapes.grids[:4], shapes.categories[:4])
    train(few, ShapeTrainingConfig(epochs=1, batch_size=4), checkpoint=checkpoint)
    with pytest.raises(PerceptionError, match=r"belongs to another configuration .*delete it"):
        train(few, ShapeTrainingConfig(epochs=2, batch_size=4), checkpoint=checkpoint)
    checkpoint.write_bytes(b"nonsense")
    with pytest.raises(PerceptionError, match=r"cannot be read .*delete it"):
        train(few, ShapeTrainingConfig(epochs=1, batch_size=4), checkpoint=checkpoint)


def test_empty_data_and_zero_epochs_are_rejected():
    empty = ShapeDataset(np.zeros((0, 32, 32, 32), np.uint8), np.zeros(0, int))
    with pytest.raises(InvalidInputError, match="no shapes"):
        train(empty, CONFIG)
    with pytest.raises(InvalidInputError, match="must be positive"):
        ShapeTrainingConfig(epochs=0)


def test_the_learning_rate_rises_and_falls_to_zero():
    config = ShapeTrainingConfig(learning_rate=1.0, warmup_steps=10)
    assert learning_rate(config, 0, 1000) == pytest.approx(0.1)
    assert learning_rate(config, 500, 1000) == pytest.approx(0.5)
    assert learning_rate(config, 1000, 1000) == pytest.approx(0.0)


def test_the_loss_of_an_epoch_is_that_of_mirrored_shapes_and_sampled_codes(shapes):
    """One batch, hence the loss of the initial network, with all weights of the configuration."""
    few = ShapeDataset(shapes.grids[::8], shapes.categories[::8])
    config = ShapeTrainingConfig(epochs=2, batch_size=4, seed=3, loss=LossConfig(beta=20, thin=5, handle=7))
    run = TrainingRun.start(config, "cpu")
    model = deepcopy(run.model)
    record = train_epoch(run, few, 1)
    rng = np.random.default_rng([3, 1])
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    ((grids, categories),) = few.batches(4, rng)
    targets = torch.from_numpy(occupancies(grids))
    weights = torch.from_numpy(voxel_weights(grids, categories, config.loss))
    one_hot = class_one_hot(torch.from_numpy(categories))
    with torch.no_grad():
        logits, mean, log_variance = model(targets, one_hot, torch.randn(4, 16, generator=generator))
    loss, divergence = shape_loss(logits, targets, weights, mean, log_variance, 20)
    assert record.epoch == 2
    assert record.loss == pytest.approx(float(loss), rel=1e-5)
    assert record.divergence == pytest.approx(float(divergence), rel=1e-5)
    # Adam's first step moves every parameter with a gradient by the learning rate
    moved = (run.model.decoder.out_bias - model.decoder.out_bias).detach().abs().item()
    assert moved == pytest.approx(learning_rate(config, 1, 2), rel=0.01)


def test_divergence_of_the_training_is_reported(shapes):
    few = ShapeDataset(shapes.grids[::16], shapes.categories[::16])
    with pytest.raises(PerceptionError, match="training diverged in epoch 2; lower the learning rate"):
        train(few, ShapeTrainingConfig(epochs=3, learning_rate=1e30, warmup_steps=0))
