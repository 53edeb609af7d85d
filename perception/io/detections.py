"""``detections.json`` of a scan folder: COCO results with run-length masks, checked before believed.

Format: https://cocodataset.org/#format-results, with ``category_name`` in place of a number,
``instance_id`` tying one object across images, and optionally the detector's class and yaw probabilities.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from pycocotools import mask as coco

from perception.errors import InvalidInputError
from perception.io.files import read_json, write_json
from perception.types import CATEGORIES, ObjectDetection, RgbdFrame

REMEDY = "repair it, or delete it to use the shipped detector"


def write_detections(folder: str | Path, detections: Sequence[Sequence[ObjectDetection]]) -> None:
    """Write ``detections.json``; the k-th sequence belongs to image id k."""
    write_entries(folder, [encode_detections(i, found) for i, found in enumerate(detections)])


def write_entries(folder: str | Path, entries: Iterable[Sequence[tuple[int, Any]]]) -> None:
    """Write ``detections.json`` from the entries of each image."""
    write_json(Path(folder) / "detections.json", [entry for image in entries for _, entry in image])


def encode_detections(image_id: int, detections: Sequence[ObjectDetection]) -> list[tuple[int, Any]]:
    """The numbered entries of one image; ``decode_detections`` is the way back."""
    return [(index, _detection_entry(image_id, found)) for index, found in enumerate(detections)]


def read_detections(
    folder: Path, frames: dict[int, RgbdFrame], known_ids: set[int]
) -> tuple[tuple[ObjectDetection, ...], ...] | None:
    """The detections of each frame, or None where the folder has no ``detections.json``.

    Args:
        folder: the scan folder.
        frames: the usable images by id; detections of unusable ones are passed over.
        known_ids: all image ids of the folder.

    Raises:
        InvalidInputError: naming the file, the entry, what is wrong and what to do.
    """
    grouped = group_detections(folder, known_ids)
    if grouped is None:
        return None
    return tuple(
        tuple(decode_detections(folder, grouped.get(i, []), i, frame)) for i, frame in frames.items()
    )


def group_detections(folder: Path, known_ids: set[int]) -> dict[int, list[Any]] | None:
    """The entries of each image as they stand in the file, masks still encoded; None where there is no file.

    Raises:
        InvalidInputError: the file is no list, or an entry belongs to no image.
    """
    path = folder / "detections.json"
    if not path.exists():
        return None
    entries = read_json(path, REMEDY)
    if not isinstance(entries, list):
        raise InvalidInputError(f"{path} must be a list of detections: {REMEDY}")
    grouped: dict[int, list[Any]] = {}
    for index, entry in enumerate(entries):
        image_id = entry.get("image_id") if isinstance(entry, dict) else None
        if type(image_id) is not int or image_id not in known_ids:
            problem = f"image_id {image_id!r} is not in scene_camera.json"
            raise InvalidInputError(f"{path}, entry {index}: {problem}: {REMEDY}")
        grouped.setdefault(image_id, []).append((index, entry))
    return grouped


def decode_detections(
    folder: Path, entries: Sequence[tuple[int, Any]], image_id: int, frame: RgbdFrame
) -> list[ObjectDetection]:
    """Detections of one image from its numbered entries.

    Raises:
        InvalidInputError: naming the entry and what is wrong.
    """
    found = []
    for index, entry in entries:
        try:
            found.append(_detection(entry, frame))
        except InvalidInputError as error:
            message = f"{folder / 'detections.json'}, entry {index} (image {image_id}): {error}: {REMEDY}"
            raise InvalidInputError(message) from None
    return found


def _detection_entry(image_id: int, found: ObjectDetection) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "image_id": image_id,
        "category_name": found.category,
        "score": float(found.score),
        "segmentation": encode_mask(found.mask),
    }
    if found.instance_id is not None:
        entry["instance_id"] = int(found.instance_id)
    for key in ("class_probabilities", "yaw_probabilities"):
        if getattr(found, key).size:
            entry[key] = [round(float(p), 6) for p in getattr(found, key)]
    return entry


def _detection(entry: dict[str, Any], frame: RgbdFrame) -> ObjectDetection:
    category, score, instance = entry.get("category_name"), entry.get("score", 1.0), entry.get("instance_id")
    if category not in CATEGORIES:
        raise InvalidInputError(f"category_name {category!r} is none of {', '.join(CATEGORIES)}")
    if isinstance(score, bool) or not isinstance(score, int | float) or not 0 <= score <= 1:
        raise InvalidInputError(f"score {score!r} must be a number in 0..1")
    if instance is not None and (isinstance(instance, bool) or not isinstance(instance, int) or instance < 0):
        raise InvalidInputError(f"instance_id {instance!r} must be a whole number from 0")
    mask = decode_mask(entry.get("segmentation"), (frame.intrinsics.height, frame.intrinsics.width))
    return ObjectDetection(
        category=category,
        score=float(score),
        mask=mask,
        class_probabilities=_probabilities(entry, "class_probabilities"),
        yaw_probabilities=_probabilities(entry, "yaw_probabilities"),
        instance_id=instance,
    )


def _probabilities(entry: dict[str, Any], key: str) -> np.ndarray:
    value = entry.get(key, [])
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.full(1, np.nan)
    if numbers.ndim != 1 or not ((numbers >= 0) & (numbers <= 1)).all():
        raise InvalidInputError(f"{key} must be a list of numbers in 0..1")
    return numbers


def encode_mask(mask: Bool[np.ndarray, "h w"]) -> dict[str, Any]:
    """The mask as {"size": [h, w], "counts": text}, ready for JSON."""
    code: Any = coco.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": [int(n) for n in code["size"]], "counts": code["counts"].decode("ascii")}


def decode_mask(code: Any, size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Decode a COCO run-length code whose image must have the given (height, width).

    pycocotools accepts codes that are cut short and guesses the rest; here the runs must add up.

    Raises:
        InvalidInputError: not a run-length code, of another size, or its runs don't fill the image.
    """
    if not isinstance(code, dict) or "counts" not in code or "size" not in code:
        raise InvalidInputError('mask must be a COCO run-length code {"size": [h, w], "counts": ...}')
    if not isinstance(code["size"], list) or code["size"] != list(size):
        raise InvalidInputError(
            f"mask has size {code['size']} but the image has {list(size)} (height, width)"
        )
    counts = code["counts"]
    try:
        runs = _decompress(counts) if isinstance(counts, str) else [int(run) for run in counts]
    except (TypeError, ValueError, IndexError, OverflowError):
        raise InvalidInputError("mask counts do not decode as a COCO run-length code") from None
    pixels = size[0] * size[1]
    if any(run < 0 for run in runs) or sum(runs) != pixels:
        raise InvalidInputError(
            f"mask runs cover {sum(runs)} of {pixels} pixels: the run-length code is damaged"
        )
    values = np.arange(len(runs)) % 2 == 1
    return np.repeat(values, runs).reshape(size[::-1]).T.copy()  # COCO counts down the columns


def _decompress(text: str) -> list[int]:
    """Runs from COCO's text: 5 bits a character from 48 up, bit 6 continues, less the run two before."""
    runs: list[int] = []
    position = 0
    while position < len(text):
        value, shift, more = 0, 0, True
        while more:
            chunk = ord(text[position]) - 48
            if not 0 <= chunk < 64 or shift > 60:
                raise ValueError(text[position])
            value |= (chunk & 0x1F) << shift
            more = bool(chunk & 0x20)
            position += 1
            shift += 5
            if not more and chunk & 0x10:
                value -= 1 << shift
        runs.append(value + runs[-2] if len(runs) > 2 else value)
    return runs
