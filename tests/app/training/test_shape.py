"""`nodeslam train shape` on a handful of shapes: its files, going on after an interruption, its card."""

import json

import pytest

from app.training.resources import Resources
from app.training.shape import TrainShapeConfig, run
from perception.io.weights import weights_checksum
from perception.shape.decoder import ShapeDecoder
from perception.shape.training import ShapeTrainingConfig

TINY = TrainShapeConfig(
    mugs=6,
    bowls=2,
    bottles=2,
    cans=2,
    held_out=2,
    evaluate_every=1,
    training=ShapeTrainingConfig(epochs=2, batch_size=4),
)


def test_an_interrupted_job_goes_on_and_leaves_weights_and_card(tmp_path):
    steps = []

    def interrupt(what: str, share: float) -> None:
        steps.append((what, share))
        if what == "epoch 2 of 2":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(TINY, tmp_path, interrupt)
    assert len(json.loads((tmp_path / "history.json").read_text())) == 1
    assert not (tmp_path / "shape.safetensors").exists()

    first = (tmp_path / "history.json").read_text()[:-2]  # killed before the checkpoint of epoch 2
    (tmp_path / "history.json").write_text(first + ', {"epoch": 2}]')

    metrics = run(TINY, tmp_path)
    assert [entry["epoch"] for entry in json.loads((tmp_path / "history.json").read_text())] == [1, 2]
    assert steps[0] == ("sampling shapes", 0.0)
    assert set(metrics["held_out"]) == {"mug", "bowl", "bottle", "can"}
    assert metrics["held_out"]["can"]["handle_recall"] is None
    assert metrics["sha256"] == weights_checksum(tmp_path / "shape.safetensors")
    ShapeDecoder.load(tmp_path / "shape.safetensors")
    card = (tmp_path / "shape.md").read_text()
    assert metrics["sha256"] in card
    assert "6 mugs, 2 bowls, 2 bottles, 2 cans" in card


@pytest.mark.slow
def test_several_processes_go_on_from_the_checkpoint_of_one(tmp_path):
    def interrupt(what: str, share: float) -> None:
        if what == "epoch 2 of 2":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(TINY, tmp_path, interrupt)
    steps = []
    metrics = run(TINY, tmp_path, lambda *step: steps.append(step), Resources(processes=2))
    assert [what for what, _ in steps if what.startswith("epoch")] == ["epoch 2 of 2"] * 3
    history = json.loads((tmp_path / "history.json").read_text())
    assert [entry["epoch"] for entry in history] == [1, 2] and "held_out" in history[1]
    assert metrics["sha256"] == weights_checksum(tmp_path / "shape.safetensors")
    assert not (tmp_path / "mapped").exists()
