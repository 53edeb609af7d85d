"""`nodeslam train verifier`: train the network that scores upright fits to single views.

The data are those of ``acceptance``: rendered scenes of the training families, each instance that the
detector segments reconstructed from one view as its two most probable classes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import nn

from app.training.acceptance import acceptance_metrics, acceptance_table, share_metrics
from app.training.acceptance_fits import collect
from app.training.crop_dataset import Progress
from app.training.files import checksums
from app.training.resources import Resources
from perception.errors import PerceptionError
from perception.inference.acceptance import LINEAR, AcceptanceModel
from perception.inference.evidence import Evidence
from perception.inference.verifier import LOGIT_SCALE, WEIGHTS_FILE, Verifier
from perception.types import OTHER

_CONTEXT = slice(len(LINEAR), len(LINEAR) + OTHER + 2)  # inputs that depend on the class probabilities


@dataclass(frozen=True)
class VerifierTraining:
    """Hyperparameters of the training.

    Attributes:
        seed: Seed of the images, the weights and the noise.
        epochs: Passes over the fits.
        members: Number of perceptrons, whose logits are averaged.
        hidden: Number of hidden units of each.
        batch: Fits per step.
        rate: Highest learning rate.
        weight_decay: Decoupled weight decay.
        dropout: Share of the hidden units that are left out.
        smoothing: Distance of the targets from 0 and 1.
        class_noise: Standard deviation of the noise on the logits of the class probabilities, in nats. The
            detector is surer on the kinds it was trained on than on others.
        class_dropout: Share of the fits without class probabilities.
        threshold: Score below which objects are rejected.
    """

    seed: int = 0
    epochs: int = 14
    members: int = 5
    hidden: int = 24
    batch: int = 128
    rate: float = 4e-3
    weight_decay: float = 0.1
    dropout: float = 0.3
    smoothing: float = 0.01
    class_noise: float = 2.0
    class_dropout: float = 0.4
    threshold: float = 0.2


@dataclass(frozen=True)
class TrainVerifierConfig:
    """Configuration of the job; the defaults are those of the shipped weights.

    Attributes:
        pictures: Number of images of the training split.
        test: Number of images of the test split, for the evaluation.
        training: Hyperparameters of the training.
        device: Device of the networks; fits and training run on the CPU.
    """

    pictures: int = 1000
    test: int = 60
    training: VerifierTraining = VerifierTraining()
    device: str = "cpu"


def run(
    config: TrainVerifierConfig,
    out_dir: Path,
    progress: Progress | None = None,
    resources: Resources = Resources(),
) -> dict[str, Any]:
    """Reconstruct rendered scenes, train the network and evaluate it on the test split.

    Writes `fits/`, `verifier.safetensors` and `verifier.md` to the folder; finished chunks are reused.

    Returns:
        Metrics on the test split (``share_metrics``), of the logistic models as ``logistic``.
    """
    seed, folder, model = config.training.seed, out_dir / "fits", AcceptanceModel.load()
    train = collect(folder, "train", config.pictures, seed, resources.workers, progress)
    test = collect(folder, "test", config.test, seed, resources.workers, progress)
    real = np.array([row["real"] for row in train], dtype=bool)
    verifier = train_verifier(inputs_of(train, model), real, config.training)
    verifier.save(out_dir / WEIGHTS_FILE)
    scores = np.array([verifier.score(x) for x in inputs_of(test, model)])
    metrics = share_metrics(scores, verifier.threshold, test)
    logistic = acceptance_metrics(model, test)
    card = _CARD.format(
        config=config, t=config.training, n=len(train), m=metrics, b=logistic, old=model.threshold,
        table=acceptance_table(metrics), before=acceptance_table(logistic),
    )  # fmt: skip
    (out_dir / "verifier.md").write_text(card + checksums(out_dir / WEIGHTS_FILE), "utf-8")
    return metrics | {"logistic": logistic}


def inputs_of(rows: Sequence[dict[str, Any]], model: AcceptanceModel) -> Float[np.ndarray, "n k"]:
    """Return the inputs of the network for fits.

    Raises:
        PerceptionError: The fits were stored without the probabilities of all classes.
    """
    if any("probabilities" not in row for row in rows):
        raise PerceptionError("the fits in this folder lack class probabilities; train into another folder")
    return np.array([
        model.verifier_inputs(Evidence(**r["evidence"]), r["category"], np.array(r["probabilities"]))
        for r in rows
    ])  # fmt: skip


def train_verifier(
    inputs: Float[np.ndarray, "n k"], real: Bool[np.ndarray, "n"], training: VerifierTraining
) -> Verifier:
    """Train all members.

    Args:
        inputs: Inputs of the fits.
        real: Whether the mask of each shows an object of its class.
        training: Hyperparameters.

    Raises:
        PerceptionError: There are fewer fits than a batch.
    """
    if len(inputs) < training.batch:
        raise PerceptionError(
            f"{len(inputs)} fits are fewer than a batch of {training.batch}: render more images"
        )
    x, y = torch.tensor(inputs, dtype=torch.float32), torch.tensor(real, dtype=torch.float32)
    members = [_train_member(x, y, training, number) for number in range(training.members)]

    def stacked(name: str) -> np.ndarray:
        return np.stack([member.state_dict()[name].numpy() for member in members])

    return Verifier(
        stacked("0.weight"), stacked("0.bias"), stacked("3.weight")[:, 0], stacked("3.bias")[:, 0],
        training.threshold,
    )  # fmt: skip


def _train_member(x: torch.Tensor, y: torch.Tensor, training: VerifierTraining, number: int) -> nn.Sequential:
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(int(np.random.SeedSequence([training.seed, number]).generate_state(1)[0]))
        net = nn.Sequential(
            nn.Linear(x.shape[1], training.hidden), nn.ReLU(), nn.Dropout(training.dropout),
            nn.Linear(training.hidden, 1),
        )  # fmt: skip
        steps = len(x) // training.batch
        optimiser = torch.optim.AdamW(net.parameters(), weight_decay=training.weight_decay)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, training.rate, total_steps=training.epochs * steps
        )
        targets = training.smoothing + (1 - 2 * training.smoothing) * y
        for _ in range(training.epochs):
            for rows in torch.randperm(len(x))[: steps * training.batch].split(training.batch):
                logits = net(_disturbed(x[rows], training))[:, 0]
                loss = nn.functional.binary_cross_entropy_with_logits(logits, targets[rows])
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                schedule.step()
    return net


def _disturbed(x: torch.Tensor, training: VerifierTraining) -> torch.Tensor:
    """Return inputs whose class probabilities are noisy, or missing in a share of the rows."""
    x, columns = x.clone(), x[:, _CONTEXT]
    noise = training.class_noise / LOGIT_SCALE * torch.randn(len(x), 1)
    known = torch.rand(len(x), 1) >= training.class_dropout
    x[:, _CONTEXT] = torch.where(known, columns + noise, 0.0)
    return x


_CARD = """# Verifier of single views

`verifier.safetensors`: {t.members} perceptrons with {t.hidden} hidden units each, whose mean logit is the log
odds that an upright fit to one view is real and of its class. Inputs: the numbers of the evidence
(`perception/inference/evidence.py`) relative to true objects of the class, the log odds of the
[acceptance model](acceptance.md) without class probability, and the detector's probabilities of all classes.
Objects below {t.threshold} are left out. Fits to several views are scored by the acceptance model.

**Training**: `nodeslam train verifier --seed {t.seed}`: {config.pictures} scenes of the training families
with the distractors, rooms and sensors of `nodeslam train detector`; each instance that the detector segments
is reconstructed from its single view as its two most probable classes: {n} fits. Noise with a standard
deviation of {t.class_noise:g} is added to the logits of the class probabilities, and a share of
{t.class_dropout:g} of the fits has none, since the detector is surer on the kinds it was trained on than on
others.

**Evaluation** on {m[fits]} fits in {config.test} scenes of the test families and test kinds of distractors:
expected calibration error {m[calibration_error]:.3f}. Accepted, of the fits as the detector's first choice:

{table}

The acceptance model alone, whose threshold is {old:g} (calibration error {b[calibration_error]:.3f}):

{before}

Size, noise and threshold were chosen on other scenes of the test families, and with the 59 real frames of
`docs/real_images.md` in view: larger networks with less noise are better on rendered images and leave out
more objects of real ones.

**Limitations**: rendered images, upright objects, one view.
"""
