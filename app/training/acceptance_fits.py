"""The fits that the acceptance model is trained on: rendered scenes, detected, reconstructed from one view.

Each instance that the detector segments is fitted as its two most probable classes. A fit is positive if its
mask shows an object of its class.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from app.jobs import Workers
from app.training.crop_dataset import Progress, Split, perturb_plane
from app.training.scene_dataset import training_scene_config
from app.training.shards import Contents, write_shards
from perception.detection.detector import Detector, DetectorConfig
from perception.errors import PerceptionError
from perception.inference.evidence import measure_evidence
from perception.inference.fit import fit_with_grid
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectViews
from perception.inference.reconstruct import gather_instances
from perception.pipeline import load_decoder
from perception.shape.decoder import ShapeDecoder
from perception.threads import single_threaded
from perception.types import CATEGORIES, OTHER, ObjectDetection, SupportPlane

CHUNK = 20  # images per job
MIN_PURITY = 0.6  # share of a mask's pixels on the object that it is attributed to
RARE = 0.02  # probability from which on a second class is fitted


@dataclass(frozen=True)
class Chunk:
    """Images that one process renders and reconstructs.

    Attributes:
        folder: Folder of the result.
        split: Families and kinds.
        seed: Seed of the data set.
        number: Number of the chunk.
        count: Number of images.
    """

    folder: Path
    split: Split
    seed: int
    number: int
    count: int

    @property
    def path(self) -> Path:
        return self.folder / f"fits_{self.split}_seed{self.seed}_n{self.count}_{self.number:03d}.json"

    @property
    def files(self) -> tuple[Path]:
        """The file, for ``write_shards``."""
        return (self.path,)


def collect(
    folder: Path,
    split: Split,
    pictures: int,
    seed: int,
    workers: Workers = Workers(),
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Return the fits in rendered scenes; chunks that are in the folder are not repeated.

    Raises:
        PerceptionError: A chunk failed.
    """
    chunks = [
        Chunk(folder, split, seed, k, min(CHUNK, pictures - k * CHUNK)) for k in range(-(-pictures // CHUNK))
    ]
    write_shards(chunks, collect_chunk, workers, f"reconstructing {split} scenes", progress)
    return [row for chunk in chunks for row in json.loads(chunk.path.read_text("utf-8"))]


def collect_chunk(chunk: Chunk) -> Contents:
    """Render, detect and reconstruct the images of a chunk; return its file, one row for each fit."""
    from sim_assets.datasets.training_scenes import TrainingScenes

    sequence = np.random.SeedSequence([chunk.seed, chunk.number, chunk.split == "test", 7])
    rng = np.random.default_rng(sequence.spawn(1)[0])
    detector, decoder = _networks()
    scene_config = replace(training_scene_config(), pictures_per_pool=CHUNK)
    rows = []
    with (
        single_threaded(),
        TrainingScenes(chunk.split, int(sequence.generate_state(1)[0]), scene_config) as scenes,
    ):
        for image in scenes.render(chunk.count):
            plane = perturb_plane(image.plane, rng)
            found = [replace(d, instance_id=k) for k, d in enumerate(detector(image.frame, plane))]
            for views, detection in zip(gather_instances([image.frame], [found]), found):
                label = _label(image, detection)
                if label != "ignored":
                    rows += _fits(views, detection, label, decoder, plane)
    return (json.dumps(rows).encode(),)


def _label(image: Any, detection: ObjectDetection) -> str:
    """Return the class of the item that a mask shows, 'other', or 'ignored'."""
    shown = image.instances[detection.mask]
    counts = np.bincount(shown[shown >= 0], minlength=1)
    best = int(counts.argmax())
    if counts[best] < MIN_PURITY * len(shown):
        return "other"
    item = image.labels[best]
    return "ignored" if item.ignored else item.category or "other"


def _fits(
    views: ObjectViews, detection: ObjectDetection, label: str, decoder: ShapeDecoder, plane: SupportPlane
) -> list[dict[str, Any]]:
    """Return a row for each of the two most probable classes; a fit that fails has none."""
    probabilities, config = detection.class_probabilities, FitConfig()
    order = np.argsort(-probabilities[:OTHER])[:2].tolist()
    rows = []
    for rank, number in enumerate(order):
        if rank and probabilities[number] < RARE:
            continue
        category = CATEGORIES[number]
        try:
            estimate, grid = fit_with_grid(replace(views, category=category), decoder, plane, config)
            evidence = measure_evidence(estimate, grid, views.observations, plane, config.step[category])
        except PerceptionError:
            continue
        rows.append(
            {
                "category": category,
                "rank": rank,
                "real": label == category,
                "label": label,
                "probability": float(probabilities[number]),
                "probabilities": probabilities.tolist(),
                "evidence": evidence.as_dict(),
            }
        )
    return rows


@cache
def _networks() -> tuple[Detector, ShapeDecoder]:
    """Load the networks of a process; the detector keeps distractors."""
    return Detector.load("cpu", config=DetectorConfig(max_other=1.0)), load_decoder("cpu")
