"""The detection networks with ONNX Runtime on the CPU.

The graphs in ``graphs/`` have no weights: ``graph_building`` writes them once for each architecture, and the
weights of a safetensors file are given to the session.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
from jaxtyping import Float, UInt8

from perception.detection.architecture import Shapes, crop_shapes, fold_normalisations, scene_shapes
from perception.detection.tasks import OUTPUTS, SCENE_WEIGHTS_FILE, TRAINED_BY, WEIGHTS_FILES, Task
from perception.detection.weights import read_task_weights, remedy, temperature_of
from perception.detection.yaw import YAW_BINS
from perception.io.weights import WEIGHTS_DIRECTORY, check_shapes

GRAPHS_DIRECTORY = Path(__file__).parent / "graphs"
_BATCH = 256  # crops per pass
_ERROR = 3  # severity from which ONNX Runtime writes to standard error
# Crop images become floats around zero, with heights and depths in decimetres (``crop_network``).
_SCALE = (np.array([2.0, 2.0, 2.0, 1.0, 3.0, 4.0], np.float32) / np.float32(255.0))[:, None, None]
_ZERO = np.array([0.9, 0.9, 0.9, 0.0, 0.0, 2.0], np.float32)[:, None, None]


@dataclass(frozen=True)
class GraphScenePredictor:
    """The scene network; thread-safe.

    Attributes:
        session: Its graph with weights.
    """

    session: onnxruntime.InferenceSession

    @staticmethod
    def load(path: Path | None = None) -> GraphScenePredictor:
        """Load the shipped weights, or those of a file; raises as ``load_scene_predictor``."""
        path = WEIGHTS_DIRECTORY / SCENE_WEIGHTS_FILE if path is None else path
        tensors, _ = read_task_weights(path, "scene", "detector")
        return GraphScenePredictor(_session("scene", tensors, scene_shapes(), path, "detector"))

    def __call__(self, channels: Float[np.ndarray, "h w 8"]) -> Float[np.ndarray, "h2 w2 12"]:
        """Return the outputs for one view; an odd last row or column is repeated."""
        padded = np.pad(
            channels, ((0, channels.shape[0] % 2), (0, channels.shape[1] % 2), (0, 0)), mode="edge"
        )
        (answer,) = self.session.run(None, {"view": halve_resolution(padded)[None]})
        return np.asarray(answer)[0].transpose(1, 2, 0)


@dataclass(frozen=True)
class GraphCropPredictor:
    """The network or ensemble of one task on crops; thread-safe.

    Attributes:
        session: Its graph with weights.
        outputs: Number of logits.
        temperature: Divisor of the logits that calibrates the probabilities.
    """

    session: onnxruntime.InferenceSession
    outputs: int
    temperature: float

    @staticmethod
    def load(task: Task, path: Path | None = None) -> GraphCropPredictor:
        """Load the shipped weights, or those of a file; raises as ``load_scene_predictor``."""
        path = WEIGHTS_DIRECTORY / WEIGHTS_FILES[task] if path is None else path
        tensors, about = read_task_weights(path, task, TRAINED_BY[task])
        session = _session(task, tensors, crop_shapes(task), path, TRAINED_BY[task])
        return GraphCropPredictor(session, OUTPUTS[task], temperature_of(about, path))

    def __call__(
        self, images: UInt8[np.ndarray, "n side side 6"], context: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "n outputs"]:
        """Return calibrated probabilities of crops, averaged in log space with their mirror images."""
        rows = [np.zeros((0, self.outputs))]
        for start in range(0, len(images), _BATCH):
            part = slice(start, start + _BATCH)
            logits = self._mirror_averaged_logits(normalised_crops(images[part]), context[part])
            scaled = logits.astype(np.float64) / self.temperature
            weight = np.exp(scaled - scaled.max(1, keepdims=True))
            rows.append(weight / weight.sum(1, keepdims=True))
        return np.concatenate(rows)

    def _mirror_averaged_logits(
        self, images: Float[np.ndarray, "n 6 side side"], context: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "n outputs"]:
        """Return the mean logits of crops and of their mirror images, in which yaw changes its sign."""
        original, mirrored = (
            np.asarray(self.session.run(None, {"images": view, "context": context})[0])
            for view in (images, np.ascontiguousarray(images[..., ::-1]))
        )
        if self.outputs == YAW_BINS:
            mirrored = np.roll(mirrored, -1, axis=1)[:, ::-1]
        return (original + mirrored) / 2


def halve_resolution(channels: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "c4 h2 w2"]:
    """Return the image with the 2 x 2 pixels of each block as channels 4 c + 2 dy + dx, channels first."""
    height, width, count = channels.shape
    blocks = channels.reshape(height // 2, 2, width // 2, 2, count).transpose(4, 1, 3, 0, 2)
    return np.ascontiguousarray(blocks.reshape(4 * count, height // 2, width // 2), np.float32)


def normalised_crops(images: UInt8[np.ndarray, "n side side 6"]) -> Float[np.ndarray, "n 6 side side"]:
    """Return crop images as the network's input, as ``crop_network.normalise_crops``."""
    return np.ascontiguousarray(images.transpose(0, 3, 1, 2), np.float32) * _SCALE - _ZERO


def _session(
    name: str, tensors: Mapping[str, np.ndarray], shapes: Shapes, path: Path, command: str
) -> onnxruntime.InferenceSession:
    """Return a session of one thread, as frames are processed in parallel, for a graph with these weights.

    Raises:
        PerceptionError: The weights are of another network.
    """
    weights = fold_normalisations(tensors)
    check_shapes(weights, shapes, path, remedy(command))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = _ERROR
    values = [onnxruntime.OrtValue.ortvalue_from_numpy(value) for value in weights.values()]
    options.add_external_initializers(list(weights), values)
    graph = (GRAPHS_DIRECTORY / f"{name}.onnx").read_bytes()
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
