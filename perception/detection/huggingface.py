"""A Hugging Face instance-segmentation model as the detector (extra ``hf``).

The model receives the colour image only. Its labels are mapped to the classes by name, other labels are
ignored. It provides neither class probabilities nor yaw: association does without the former, ``completion``
adds the latter.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from perception.errors import PerceptionError
from perception.types import Category, ObjectDetection, RgbdFrame

# Class of the labels of common data sets (COCO, LVIS, ADE20K, Open Images).
LABELS: dict[str, Category] = {
    "mug": "mug", "cup": "mug", "coffee cup": "mug", "coffee mug": "mug", "teacup": "mug",
    "bowl": "bowl", "soup bowl": "bowl", "mixing bowl": "bowl",
    "bottle": "bottle", "water bottle": "bottle", "wine bottle": "bottle", "beer bottle": "bottle",
    "can": "can", "tin can": "can", "beer can": "can", "beverage can": "can", "soda can": "can",
}  # fmt: skip

_HUB_SECONDS = 10.0  # until the hub counts as unreachable


@dataclass(frozen=True)
class HuggingFaceDetector:
    """Detector that runs a Hugging Face model. Create it with ``load``.

    Attributes:
        name: Name or folder of the model.
        processor: Its image processor.
        model: The network.
        device: Where it runs.
        min_score: Smallest score of a detection.
    """

    name: str
    processor: Any
    model: Any
    device: str
    min_score: float = 0.5

    @staticmethod
    def load(name: str, device: str = "cpu", min_score: float = 0.5) -> HuggingFaceDetector:
        """Load a model by its name on the hub or from a local folder; its code and pickles are refused.

        Raises:
            ModuleNotFoundError: The extra ``hf`` is not installed.
            PerceptionError: The model cannot be loaded, does not segment instances, or has none of the
                classes.
        """
        import transformers

        try:
            source = _source(name)
            processor = transformers.AutoImageProcessor.from_pretrained(name, **source)
            config = transformers.AutoConfig.from_pretrained(name, **source)
            loader = _auto_class(transformers, config)
            model = loader.from_pretrained(name, config=config, use_safetensors=True, **source)
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split())[:160]
            raise PerceptionError(
                f"the Hugging Face model '{name}' cannot be loaded ({reason}): give a folder with its files, "
                "or the name of an instance-segmentation model and a connection to the hub"
            ) from None
        if not hasattr(processor, "post_process_instance_segmentation"):
            raise PerceptionError(
                f"the Hugging Face model '{name}' does not segment instances: give one that does"
            )
        known = [label for label in model.config.id2label.values() if category_of(label)]
        if not known:
            raise PerceptionError(
                f"the Hugging Face model '{name}' has no label for mugs, bowls, bottles or cans"
            )
        return HuggingFaceDetector(name, processor, model.to(device).eval(), device, min_score)

    def __call__(self, frame: RgbdFrame) -> list[ObjectDetection]:
        """Return the objects of known classes in the image by descending score."""
        height, width = frame.depth.shape
        inputs = self.processor(images=np.asarray(frame.rgb), return_tensors="pt").to(self.device)
        with torch.inference_mode():
            outputs = self.model(**inputs)
        result = self.processor.post_process_instance_segmentation(
            outputs, threshold=self.min_score, target_sizes=[(height, width)]
        )[0]
        ids = np.asarray(result["segmentation"].cpu())
        found = []
        for segment in result["segments_info"]:
            category = category_of(self.model.config.id2label[segment["label_id"]])
            mask = ids == segment["id"]
            if category is not None and mask.any():
                found.append(ObjectDetection(category, float(segment["score"]), mask))
        return sorted(found, key=lambda detection: -detection.score)


def category_of(label: str) -> Category | None:
    """Return the class for a data set's label, or None: 'cup', 'Coffee_cup' and 'cup, mug' are mugs."""
    names = [part.strip().replace("_", " ").lower() for part in label.split(",")]
    return next((LABELS[name] for name in names if name in LABELS), None)


def _source(name: str) -> dict[str, Any]:
    """Return options for loading: never run a model's code; use only local files if the hub does not answer.

    It is asked once: the library asks six times for every file.
    """
    import huggingface_hub

    local = Path(name).is_dir()
    if not local:
        try:
            huggingface_hub.HfApi().model_info(name, timeout=_HUB_SECONDS)
        except (huggingface_hub.errors.HfHubHTTPError, ValueError):
            pass  # it answers; loading reports what is wrong
        except Exception:  # exceptions of the HTTP library that it uses
            local = True
    return {"local_files_only": local, "trust_remote_code": False}


def _auto_class(transformers: Any, config: Any) -> Any:
    """Return the loader for this architecture: instance segmentation or universal segmentation."""
    for loader in (
        transformers.AutoModelForInstanceSegmentation,
        transformers.AutoModelForUniversalSegmentation,
    ):
        if type(config) in loader._model_mapping:
            return loader
    raise ValueError(f"{type(config).__name__} is not an instance-segmentation model")
