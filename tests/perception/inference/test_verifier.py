"""The network by hand, its inputs, and its file."""

from dataclasses import replace

import numpy as np
import pytest

from perception.errors import PerceptionError
from perception.inference.acceptance import LINEAR, shipped_acceptance
from perception.inference.verifier import N_CONTEXT, Verifier, verifier_inputs
from perception.io.weights import write_weights
from perception.types import CATEGORIES, OTHER

Z = np.linspace(-1.0, 1.0, 3)


@pytest.fixture
def verifier() -> Verifier:
    rng = np.random.default_rng(0)
    k = len(Z) + N_CONTEXT
    return Verifier(
        rng.normal(size=(2, 4, k)), rng.normal(size=(2, 4)), rng.normal(size=(2, 4)), np.ones(2), 0.3
    )


def test_score_by_hand() -> None:
    """Two members with one hidden unit each: logits 2 max(0, 3 - 1) + 0.5 = 4.5 and max(0, -3) - 1 = -1."""
    one = Verifier(np.array([[[3.0]], [[-3.0]]]), np.array([[-1.0], [0.0]]), np.array([[2.0], [1.0]]),
                   np.array([0.5, -1.0]), 0.3)  # fmt: skip
    assert one.score(np.array([1.0])) == pytest.approx(1 / (1 + np.exp(-(4.5 - 1.0) / 2)))


def test_inputs_by_hand() -> None:
    """Log odds of 1/2, 1/4, 1/8, 1/8 and almost 0, whose least value is 1/1000."""
    p = np.array([0.25, 0.5, 0.125, 0.125, 0.0])
    x = verifier_inputs(Z, 1.5, "mug", p)
    logits = [np.log(1 / 3), 0.0, np.log(1 / 7), np.log(1 / 7), -np.log(999)]
    own = [logits[CATEGORIES.index("mug")] / 3, *np.eye(4)[CATEGORIES.index("mug")]]
    np.testing.assert_allclose(x, [*Z, *np.array(logits) / 3, *own, 0.5])
    assert len(x) == len(Z) + N_CONTEXT and OTHER == 4


def test_a_file_is_read_as_it_was_written(verifier, tmp_path) -> None:
    path = tmp_path / "verifier.safetensors"
    verifier.save(path)
    read = Verifier.load(len(Z), path)
    x = verifier_inputs(Z, 0.3, "can", np.full(OTHER + 1, 0.2))
    assert read.threshold == 0.3 and read.score(x) == pytest.approx(verifier.score(x), abs=1e-5)


@pytest.mark.parametrize("fault", ["other inputs", "no members", "no threshold", "threshold", "missing"])
def test_files_that_hold_no_verifier_are_refused(verifier, tmp_path, fault) -> None:
    path, n = tmp_path / "verifier.safetensors", len(Z)
    names = ("hidden_weight", "hidden_bias", "output_weight", "output_bias")
    tensors = {name: getattr(verifier, name) for name in names}
    about = {"threshold": "0.3"}
    match fault:
        case "other inputs":
            n += 1
        case "no members":
            tensors = {name: tensor[:0] for name, tensor in tensors.items()}
        case "no threshold":
            about = {}
        case "threshold":
            about = {"threshold": "1.3"}
        case _:
            del tensors["output_bias"]
    write_weights(path, tensors, about)
    with pytest.raises(PerceptionError, match=r"verifier\.safetensors (do not fit|hold no verifier)"):
        Verifier.load(n, path)


def test_the_shipped_one_follows_the_detector() -> None:
    """A typical can: the more probable the class, the higher the score; its threshold is that of one view."""
    model = shipped_acceptance()
    verifier = model.verifier
    assert verifier is not None and verifier.hidden_weight.shape[2] == len(LINEAR) + N_CONTEXT
    scores = []
    for share in (0.05, 0.5, 0.95):
        p = np.full(OTHER + 1, 0.01)
        p[CATEGORIES.index("can")], p[OTHER] = share, 1 - share - 0.03
        scores.append(verifier.score(verifier_inputs(np.zeros(len(LINEAR)), 2.0, "can", p)))
    assert scores == sorted(scores) and scores[-1] > 0.8
    assert model.least_score(1) == verifier.threshold and model.least_score(2) == model.threshold
    assert replace(model, verifier=None).least_score(1) == model.threshold
