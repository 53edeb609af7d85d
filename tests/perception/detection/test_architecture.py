"""Parameters of the detection networks for inference."""

import numpy as np
import pytest

from perception.detection.architecture import crop_shapes, fold_normalisations, scene_shapes
from perception.detection.crop_network import create_network
from perception.detection.scene_network import SceneNet
from perception.detection.tasks import OUTPUTS


def folded_shapes(network):
    tensors = {name: value.numpy() for name, value in network.state_dict().items()}
    return {name: value.shape for name, value in fold_normalisations(tensors).items()}


@pytest.mark.parametrize("task", OUTPUTS)
def test_shapes_are_those_of_the_crop_networks(task):
    assert crop_shapes(task) == folded_shapes(create_network(task))


def test_shapes_are_those_of_the_scene_network():
    assert scene_shapes() == folded_shapes(SceneNet())


def block(**changed):
    parts = {"weight": [2.0], "bias": [1.0], "running_mean": [3.0], "running_var": [4.0]}
    named = {f"a.1.{part}": np.array(value, np.float16) for part, value in (parts | changed).items()}
    return {
        "a.0.weight": np.full((1, 1, 1, 1), 5.0, np.float16),
        "a.1.num_batches_tracked": np.array(9),
    } | named


def test_a_folded_convolution_has_the_normalised_weight_and_a_bias():
    folded = fold_normalisations(block() | {"b.bias": np.ones(2, np.float16)})
    assert folded.keys() == {"a.0.weight", "a.0.bias", "b.bias"}
    assert {value.dtype for value in folded.values()} == {np.dtype(np.float32)}
    np.testing.assert_allclose(folded["a.0.weight"], [[[[5.0]]]], rtol=1e-5)  # 2 / sqrt(4) * 5
    np.testing.assert_allclose(folded["a.0.bias"], [-2.0], rtol=1e-5)  # 1 - 2 / sqrt(4) * 3


@pytest.mark.parametrize("part", ["weight", "bias", "running_mean", "running_var"])
def test_normalisations_that_do_not_fit_are_left_to_the_check_of_the_shapes(part):
    assert "a.0.bias" not in fold_normalisations(block(**{part: [1.0, 2.0]}))
    incomplete = block()
    del incomplete["a.0.weight"]
    assert "a.0.bias" not in fold_normalisations(incomplete)
