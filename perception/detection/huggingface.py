"""Any instance-segmentation model of the Hugging Face hub as the detector (extra ``hf``).

The model sees the colour image alone; its labels are translated by name, and what is of none of our classes
is left out. Masks are trusted as they are, so yaw and ties across images are left to association and fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from perception.errors import PerceptionError
from perception.types import Category, ObjectDetection, RgbdFrame

# Labels of the usual data sets (COCO, LVIS, ADE20K, Open Images) by the class they mean here.
LABELS: dict[str, Category] = {
    "mug": "mug", "cup": "mug", "coffee cup": "mug", "coffee mug": "mug", "teacup": "mug",
    "bowl": "bowl", "soup bowl": "bowl", "mixing bowl": "bowl",
    "bottle": "bottle", "water bottle": "bottle", "wine bottle": "bottle", "beer bottle": "bottle",
    "can": "can", "tin can": "can", "beer can": "can", "beverage can": "can", "soda can": "can",
}  # fmt: skip


@dataclass(frozen=True)
class HuggingFaceDetector:
    """Finds objects with somebody's network. Make one with ``load``.

    Attributes:
        name: of the model.
        min_score: what is less sure is left out.
    """

    name: str
    processor: Any
    model: Any
    device: str
    min_score: float = 0.5

    @staticmethod
    def load(name: str, device: str = "cpu", min_score: float = 0.5) -> HuggingFaceDetector:
        """The model of a name on the hub, or in a local folder.

        Raises:
            ModuleNotFoundError: the extra ``hf`` is not installed.
            PerceptionError: weights can't be had, or are no instance-segmentation model.
        """
        import transformers

        try:
            processor = transformers.AutoImageProcessor.from_pretrained(name)
            config = transformers.AutoConfig.from_pretrained(name)
            model = _auto_class(transformers, config).from_pretrained(name, config=config)
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
                f"the Hugging Face model '{name}' knows neither mugs, bowls, bottles nor cans"
            )
        return HuggingFaceDetector(name, processor, model.to(device).eval(), device, min_score)

    def __call__(self, frame: RgbdFrame) -> list[ObjectDetection]:
        """Objects of our classes in the image, most certain first."""
        height, width = frame.depth.shape
        inputs = self.processor(images=np.asarray(frame.rgb), return_tensors="pt").to(self.device)
        with torch.inference_mode():
            outputs = self.model(**inputs)
        result = self.processor.post_process_instance_segmentation(
            outputs, threshold=self.min_score, target_sizes=[(height, width)]
        )[0]
        numbers = np.asarray(result["segmentation"].cpu())
        found = []
        for segment in result["segments_info"]:
            category = category_of(self.model.config.id2label[segment["label_id"]])
            mask = numbers == segment["id"]
            if category is not None and mask.any():
                found.append(ObjectDetection(category, float(segment["score"]), mask))
        return sorted(found, key=lambda detection: -detection.score)


def category_of(label: str) -> Category | None:
    """Our class of a data set's label, or None: 'cup', 'Coffee_cup' and 'cup, mug' are mugs."""
    names = [part.strip().replace("_", " ").lower() for part in label.split(",")]
    return next((LABELS[name] for name in names if name in LABELS), None)


def _auto_class(transformers: Any, config: Any) -> Any:
    """The loader that knows this architecture: instance segmentation, or the universal kind."""
    for loader in (
        transformers.AutoModelForInstanceSegmentation,
        transformers.AutoModelForUniversalSegmentation,
    ):
        if type(config) in loader._model_mapping:
            return loader
    raise ValueError(f"{type(config).__name__} is no instance segmentation")
