"""``detections.json`` of a scan folder: COCO results with run-length encoded masks, validated when read.

Format: https://cocodataset.org/#format-results, with ``category_name`` instead of a category number, an
optional ``instance_id`` that associates one object across images, and optional class and yaw probabilities.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from pycocotools import mask as coco

from perception.errors import InvalidInputError
from perception.io.arrays import numbers_of
from perception.io.files import read_json, write_json
from perception.types import CATEGORIES, OTHER, ObjectDetection, RgbdFrame, unclassified

FILE_NAME = "detections.json"
Entry = tuple[int, Any]  # index of an entry in the file or among those of its image, and its JSON value
MAX_PER_IMAGE = 200  # detections; COCO's evaluation counts 100
MAX_SUM_ERROR = 0.01  # of probabilities: files hold rounded numbers
MAX_YAW_BINS = 720
MAX_MASK_BYTES = 4 * 2**30  # of all decoded masks of a scan
_REMEDY = "repair it, or delete it to use the shipped detector"


def write_detections(folder: str | Path, detections: Sequence[Sequence[ObjectDetection]]) -> None:
    """Write ``detections.json``; the k-th sequence holds the detections of image id k."""
    write_detection_entries(folder, [encode_detections(i, found) for i, found in enumerate(detections)])


def write_detection_entries(folder: str | Path, entries: Iterable[Sequence[Entry]]) -> None:
    """Write ``detections.json`` from the encoded entries of each image."""
    write_json(Path(folder) / FILE_NAME, [entry for image in entries for _, entry in image])


def encode_detections(image_id: int, detections: Sequence[ObjectDetection]) -> list[Entry]:
    """Encode the detections of one image; inverse of ``decode_detections``."""
    return [(index, _detection_entry(image_id, found)) for index, found in enumerate(detections)]


def read_detections(
    folder: Path, frames: dict[int, RgbdFrame], known_ids: set[int]
) -> tuple[tuple[ObjectDetection, ...], ...] | None:
    """Read the detections of each frame; None if the folder has no ``detections.json``.

    Args:
        folder: Scan folder.
        frames: Usable images by id; detections of other images are ignored.
        known_ids: All image ids of the folder.

    Raises:
        InvalidInputError: The message names the file, the entry, the problem and the remedy.
    """
    grouped = read_detection_entries(folder, known_ids)
    if grouped is None:
        return None
    n_bytes = sum(len(grouped.get(i, ())) * frame.depth.size for i, frame in frames.items())
    if n_bytes > MAX_MASK_BYTES:
        raise InvalidInputError(
            f"{folder / FILE_NAME} holds masks of {n_bytes / 2**30:.1f} GiB, at most "
            f"{MAX_MASK_BYTES / 2**30:.0f} GiB are decoded: split the scan, or keep the best detections"
        )
    return tuple(
        tuple(decode_detections(folder, grouped.get(i, []), i, frame, class_required=False))
        for i, frame in frames.items()
    )


def read_detection_entries(folder: Path, known_ids: set[int]) -> dict[int, list[Entry]] | None:
    """Read the entries of each image without decoding them; None if there is no file.

    Raises:
        InvalidInputError: The file is not a list, an entry has an unknown image id, or an image has more than
            MAX_PER_IMAGE entries.
    """
    path = folder / FILE_NAME
    if not path.exists():
        return None
    entries = read_json(path, _REMEDY)
    if not isinstance(entries, list):
        raise InvalidInputError(f"{path} must be a list of detections: {_REMEDY}")
    grouped: dict[int, list[Entry]] = {}
    for index, entry in enumerate(entries):
        image_id = entry.get("image_id") if isinstance(entry, dict) else None
        if type(image_id) is not int or image_id not in known_ids:
            problem = f"image_id {repr(image_id)[:80]} is not in scene_camera.json"
            raise InvalidInputError(f"{path}, entry {index}: {problem}: {_REMEDY}")
        found = grouped.setdefault(image_id, [])
        if len(found) == MAX_PER_IMAGE:
            raise InvalidInputError(
                f"{path}: image {image_id} has more than {MAX_PER_IMAGE} detections: keep the best ones"
            )
        found.append((index, entry))
    return grouped


def decode_detections(
    folder: Path, entries: Sequence[Entry], image_id: int, frame: RgbdFrame, class_required: bool = True
) -> list[ObjectDetection]:
    """Decode the entries of one image.

    Args:
        folder: Scan folder.
        entries: Entries of the image.
        image_id: Number of the image.
        frame: The image.
        class_required: Whether an entry without ``category_name`` is an error; it is ``unclassified`` if not.

    Raises:
        InvalidInputError: The message names the entry and the problem.
    """
    found = []
    for index, entry in entries:
        try:
            found.append(_detection(entry, frame, class_required))
        except InvalidInputError as error:
            message = f"{folder / FILE_NAME}, entry {index} (image {image_id}): {error}: {_REMEDY}"
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


def _detection(entry: dict[str, Any], frame: RgbdFrame, class_required: bool) -> ObjectDetection:
    category, score, instance = entry.get("category_name"), entry.get("score", 1.0), entry.get("instance_id")
    bare = category is None and not class_required
    if category not in CATEGORIES and not bare:
        raise InvalidInputError(f"category_name {repr(category)[:80]} is none of {', '.join(CATEGORIES)}")
    if isinstance(score, bool) or not isinstance(score, int | float) or not 0 <= score <= 1:
        raise InvalidInputError(f"score {repr(score)[:80]} must be a number in 0..1")
    if instance is not None and (isinstance(instance, bool) or not isinstance(instance, int) or instance < 0):
        raise InvalidInputError(f"instance_id {repr(instance)[:80]} must be a whole number from 0")
    mask = decode_mask(entry.get("segmentation"), (frame.intrinsics.height, frame.intrinsics.width))
    if category is None:
        return unclassified(mask, instance)
    return ObjectDetection(
        category=category,
        score=float(score),
        mask=mask,
        class_probabilities=_probabilities(entry, "class_probabilities", range(OTHER + 1, OTHER + 2)),
        yaw_probabilities=_probabilities(entry, "yaw_probabilities", range(2, MAX_YAW_BINS + 1)),
        instance_id=instance,
    )


def _probabilities(entry: dict[str, Any], key: str, counts: range) -> np.ndarray:
    """Return probabilities, of which there must be one of the counts or none; raise InvalidInputError."""
    value = entry.get(key, [])
    try:
        numbers = numbers_of(value)
    except ValueError:
        numbers = np.full(1, np.nan)
    if numbers.ndim != 1 or not ((numbers >= 0) & (numbers <= 1)).all():
        raise InvalidInputError(f"{key} must be a list of numbers in 0..1")
    if numbers.size and numbers.size not in counts:
        raise InvalidInputError(f"{key} must hold {counts[0]} to {counts[-1]} numbers, not {numbers.size}")
    if numbers.size and abs(numbers.sum() - 1) > MAX_SUM_ERROR:
        raise InvalidInputError(f"{key} must sum to 1, not to {numbers.sum():.3g}")
    return numbers


def encode_mask(mask: Bool[np.ndarray, "h w"]) -> dict[str, Any]:
    """Encode a mask as a COCO run-length code {"size": [h, w], "counts": text}."""
    code: Any = coco.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": [int(n) for n in code["size"]], "counts": code["counts"].decode("ascii")}


def decode_mask(code: Any, size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Decode a COCO run-length code of an image with the given (height, width).

    Unlike pycocotools, which pads truncated codes, the runs must cover the image exactly.

    Raises:
        InvalidInputError: Not a run-length code, of another size, or its runs do not cover the image.
    """
    if not isinstance(code, dict) or "counts" not in code or "size" not in code:
        raise InvalidInputError('mask must be a COCO run-length code {"size": [h, w], "counts": ...}')
    if not isinstance(code["size"], list) or code["size"] != list(size):
        raise InvalidInputError(
            f"mask has size {repr(code['size'])[:80]} but the image has {list(size)} (height, width)"
        )
    counts = code["counts"]
    try:
        runs = _decompress(counts) if isinstance(counts, str) else [_run(run) for run in counts]
    except (TypeError, ValueError, IndexError, OverflowError):
        raise InvalidInputError("mask counts do not decode as a COCO run-length code") from None
    pixels = size[0] * size[1]
    if any(run < 0 for run in runs) or sum(runs) != pixels:
        raise InvalidInputError(
            f"mask runs cover {sum(runs)} of {pixels} pixels: the run-length code is damaged"
        )
    values = np.arange(len(runs)) % 2 == 1
    return np.repeat(values, runs).reshape(size[::-1]).T.copy()  # runs are in column-major order


def _run(value: Any) -> int:
    if type(value) is not int:
        raise TypeError(value)
    return value


def _decompress(text: str) -> list[int]:
    """Return the runs of COCO's compressed text.

    Each character minus 48 holds 5 bits, least significant first, and a continuation bit; from the fourth run
    on the values are differences to the run two before.
    """
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
