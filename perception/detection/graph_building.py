"""Graphs of the detection networks for ONNX Runtime, without weights::

    python -m perception.detection.graph_building

writes them to ``graphs/``. It is run after an architecture has changed; new weights of the same architecture
need no new graphs. Weights are declared as external data and given to the session by ``graph_predictors``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from onnx import ModelProto, NodeProto, TensorProto, helper

from perception.detection import crops, working_view
from perception.detection.architecture import (
    CROP_SIZES,
    SCENE_RESIDUALS,
    SCENE_WIDTHS,
    Shapes,
    crop_shapes,
    scene_shapes,
)
from perception.detection.graph_predictors import GRAPHS_DIRECTORY
from perception.detection.tasks import ENSEMBLE_SIZE, OUTPUTS, SCENE_OUTPUTS, Task

_OPERATORS = 18  # version of the operators; Resize and Shape changed last in it
_FORMAT = 9  # version of the file format, the one that belongs to these operators


class _Graph:
    """A graph under construction; its methods add a node and return the name of the node's output."""

    def __init__(self, shapes: Shapes) -> None:
        self._shapes = shapes
        self._nodes: list[NodeProto] = []

    def add(self, operator: str, inputs: Sequence[str], **attributes: Any) -> str:
        """Add a node of one output."""
        output = f"{operator.lower()}{len(self._nodes)}"
        self._nodes.append(helper.make_node(operator, list(inputs), [output], **attributes))
        return output

    def convolution(self, x: str, name: str, stride: int = 1, relu: bool = True) -> str:
        """Add the convolution of a folded block, with zero padding that keeps the size up to the stride."""
        side = self._shapes[f"{name}.weight"][-1]
        x = self.add(
            "Conv", (x, f"{name}.weight", f"{name}.bias"), strides=[stride] * 2, pads=[side // 2] * 4
        )
        return self.relu(x) if relu else x

    def linear(self, x: str, name: str) -> str:
        """Add a linear layer."""
        return self.add("Gemm", (x, f"{name}.weight", f"{name}.bias"), transB=1)

    def relu(self, x: str) -> str:
        """Add a ReLU."""
        return self.add("Relu", (x,))

    def enlarged(self, x: str, like: str) -> str:
        """Resize an image bilinearly to the size of another."""
        size = self.add(
            "Concat", (self.add("Shape", (x,), end=2), self.add("Shape", (like,), start=2)), axis=0
        )
        return self.add(
            "Resize", (x, "", "", size), mode="linear", coordinate_transformation_mode="half_pixel"
        )

    def mean(self, parts: Sequence[str]) -> str:
        """Add the mean of several tensors; one is its own mean."""
        return parts[0] if len(parts) == 1 else self.add("Mean", parts)

    def model(self, inputs: dict[str, list[str | int]], output: str, shape: list[str | int]) -> ModelProto:
        """Return the model, whose output is named ``answer``."""
        nodes = [*self._nodes, helper.make_node("Identity", [output], ["answer"])]
        floats = TensorProto.FLOAT
        graph = helper.make_graph(
            nodes,
            "network",
            [helper.make_tensor_value_info(name, floats, sizes) for name, sizes in inputs.items()],
            [helper.make_tensor_value_info("answer", floats, shape)],
            [_external(name, sizes) for name, sizes in self._shapes.items()],
        )
        version = helper.make_opsetid("", _OPERATORS)
        return helper.make_model(graph, opset_imports=[version], ir_version=_FORMAT, producer_name="nodeslam")


def scene_graph() -> ModelProto:
    """Return the graph of ``scene_network.SceneNet`` after its ``pixel_unshuffle``."""
    graph, x, levels = _Graph(scene_shapes()), "view", []
    for stage in range(len(SCENE_WIDTHS)):
        name, residuals = f"down.{stage}", SCENE_RESIDUALS[stage]
        x = graph.convolution(x, f"{name}.0.0" if stage else f"{name}.0", stride=2 if stage else 1)
        if stage and not residuals:
            x = graph.convolution(x, f"{name}.1.0")
        for block in range(1, 1 + residuals):
            first = graph.convolution(x, f"{name}.{block}.first.0")
            second = graph.convolution(first, f"{name}.{block}.second.0", relu=False)
            x = graph.relu(graph.add("Add", (x, second)))
        levels.append(x)
    lateral = [graph.convolution(x, f"across.{k}.0", relu=False) for k, x in enumerate(levels)]
    x = graph.add("Add", (lateral[3], graph.enlarged(lateral[4], lateral[3])))
    x = graph.convolution(graph.add("Add", (lateral[2], graph.enlarged(x, lateral[2]))), "joined.2.0")
    for k in (1, 0):
        x = graph.enlarged(graph.convolution(x, f"narrower.{k}", relu=False), lateral[k])
        x = graph.convolution(graph.add("Add", (lateral[k], x)), f"joined.{k}.0")
    x = graph.convolution(x, "answer", relu=False)
    view = ["n", 4 * working_view.CHANNELS, "h", "w"]
    return graph.model({"view": view}, x, ["n", SCENE_OUTPUTS, "h", "w"])


def crop_graph(task: Task) -> ModelProto:
    """Return the graph of ``crop_network.create_network(task)``, whose answer are the mean logits."""
    graph, logits, members = _Graph(crop_shapes(task)), [], ENSEMBLE_SIZE[task]
    for prefix in [""] if members == 1 else [f"members.{member}." for member in range(members)]:
        x = graph.convolution("images", f"{prefix}features.0.0", stride=2)
        last = 2 * len(CROP_SIZES.widths) - 1
        for layer in range(1, last):
            x = graph.convolution(x, f"{prefix}features.{layer}.0", stride=2 if layer % 2 else 1)
        x = graph.add("Flatten", (graph.convolution(x, f"{prefix}features.{last}.0"),))
        x = graph.relu(graph.linear(graph.add("Concat", (x, "context"), axis=1), f"{prefix}head.0"))
        logits.append(graph.linear(x, f"{prefix}logits"))
    inputs = {"images": ["n", crops.CHANNELS, crops.SIDE, crops.SIDE], "context": ["n", crops.CONTEXT]}
    return graph.model(inputs, graph.mean(logits), ["n", OUTPUTS[task]])


def graphs() -> dict[str, bytes]:
    """Return the content of all graph files by name."""
    models = {"scene": scene_graph()} | {task: crop_graph(task) for task in OUTPUTS}
    return {f"{name}.onnx": model.SerializeToString(deterministic=True) for name, model in models.items()}


def write_graphs(directory: Path = GRAPHS_DIRECTORY) -> None:
    """Write all graph files."""
    directory.mkdir(exist_ok=True)
    for name, content in graphs().items():
        (directory / name).write_bytes(content)


def _external(name: str, shape: Sequence[int]) -> TensorProto:
    """Declare a weight whose numbers are not in the file."""
    tensor = TensorProto(name=name, data_type=TensorProto.FLOAT, dims=shape)
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="weights")
    return tensor


if __name__ == "__main__":
    write_graphs()
