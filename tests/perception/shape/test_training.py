"""Training learns, resumes to the bit and refuses what is foreign; the loss sees thin things and handles."""

import numpy as np
import pytest
import torch

from perception.errors import InvalidInputError, PerceptionError
from perception.shape.dataset import ShapeDataset, mirrored, occupancies
from perception.shape.losses import LossConfig, handle_region, shape_loss, thin_structures, voxel_weights
from perception.shape.training import EpochRecord, ShapeTrainingConfig, learning_rate, train
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


def test_checkpoints_of_other_runs_and_broken_ones_are_refused(shapes, tmp_path):
    checkpoint = tmp_path / "checkpoint.pt"
    few = ShapeDataset(shapes.grids[:4], shapes.categories[:4])
    train(few, ShapeTrainingConfig(epochs=1, batch_size=4), checkpoint=checkpoint)
    with pytest.raises(PerceptionError, match=r"belongs to another configuration .*delete it"):
        train(few, ShapeTrainingConfig(epochs=2, batch_size=4), checkpoint=checkpoint)
    checkpoint.write_bytes(b"nonsense")
    with pytest.raises(PerceptionError, match=r"cannot be read .*delete it"):
        train(few, ShapeTrainingConfig(epochs=1, batch_size=4), checkpoint=checkpoint)


def test_no_shapes_and_no_epochs_are_refused():
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


def test_only_the_handle_of_a_mug_is_its_handle():
    grid = (mug(8) * 255).astype(np.uint8)
    as_mug, as_can = handle_region(np.array([grid, grid]), np.array([MUG, CAN]))
    handle = as_mug & (grid > 0)
    assert not as_can.any()
    assert handle.any()
    assert X[handle].min() > 4  # the body ends at x = -4 + 8
    assert handle.sum() == np.count_nonzero((grid > 0) & (X > 4))


def test_thin_structures_are_walls_not_blocks():
    wall = np.zeros((1, 32, 32, 32), np.uint8)
    wall[0, 10:12, 4:28, 4:28] = 200
    block = np.zeros_like(wall)
    block[0, 8:14, 4:28, 4:28] = 255
    assert np.array_equal(thin_structures(wall), wall)
    assert not thin_structures(block).any()


def test_weights_are_one_in_the_open_and_add_up_at_a_handle():
    grids = (mug(8)[None] * 255).astype(np.uint8)
    config = LossConfig(thin=1.0, handle=3.0)
    weights = voxel_weights(grids, np.array([MUG]), config)
    assert weights.min() == 1.0
    assert weights.max() == pytest.approx(5.0)
    assert np.unique(voxel_weights(grids, np.array([MUG]), LossConfig(thin=0, handle=0))) == [1.0]


def test_loss_of_a_certain_and_right_answer_is_the_divergence():
    grids = torch.zeros(2, 4, 4, 4)
    grids[:, 1] = 1
    mean, log_variance = torch.ones(2, 16), torch.zeros(2, 16)
    loss, divergence = shape_loss(200 * grids - 100, grids, torch.ones_like(grids), mean, log_variance, 0.5)
    assert divergence.item() == pytest.approx(8.0)  # 16 entries of 1/2 mean^2
    assert loss.item() == pytest.approx(4.0)


def test_mirroring_keeps_handles_in_front():
    grids = np.repeat((mug(8)[None] * 255).astype(np.uint8), 16, 0)
    grids[:, :, :10] = 0  # something to tell left from right by
    mugs = mirrored(grids, np.full(16, MUG), np.random.default_rng(0))
    cans = mirrored(grids, np.full(16, CAN), np.random.default_rng(0))
    assert {bool((grid == grids[0]).all()) for grid in mugs} == {True, False}
    assert (mugs.any((2, 3)) == grids.any((2, 3))).all()
    assert not (cans.any((2, 3)) == grids.any((2, 3))).all()


def test_data_survive_the_file(shapes, tmp_path):
    path = tmp_path / "shapes.npz"
    shapes.save(path)
    loaded = ShapeDataset.load(path)
    assert np.array_equal(loaded.grids, shapes.grids)
    assert np.array_equal(loaded.of("can").categories, np.full(16, CAN))
    assert occupancies(loaded.grids).max() == 1.0
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InvalidInputError, match="delete it"):
        ShapeDataset.load(path)


def test_wrong_grids_are_refused():
    with pytest.raises(InvalidInputError, match="expected uint8"):
        ShapeDataset(np.zeros((2, 16, 16, 16), np.uint8), np.zeros(2, int))
    with pytest.raises(InvalidInputError, match=r"in 0\.\.3"):
        ShapeDataset(np.zeros((1, 32, 32, 32), np.uint8), np.array([4]))
    with pytest.raises(InvalidInputError, match=r"\[0, 1\]"):
        ShapeDataset.from_grids({"mug": np.full((1, 32, 32, 32), np.nan, np.float32)})
