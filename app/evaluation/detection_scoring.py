"""Scoring of detections in single images against ground truth, and summary over many images.

An object or distractor counts if at least MIN_PIXELS of its pixels (at 640 x 480) and MIN_VISIBLE of its
silhouette are visible; others are ignored, neither required nor false positives. A detection is accepted as
an object if one of the classes is more probable than 'other'.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from app.training.crop_dataset import handle_share
from app.training.yaw import HANDLE_VISIBLE, angle_between
from perception.detection.geometry import points_of
from perception.detection.yaw import entropy, modes
from perception.io.detections import encode_mask
from perception.types import CATEGORIES, OTHER, ObjectDetection

if TYPE_CHECKING:
    from sim_assets.datasets.labels import LabelledImage

MIN_PIXELS = 300
MIN_VISIBLE = 0.25
MIN_IOU = 0.5  # a detection with a larger IoU is matched to the object
VISIBLE_SHARES = (MIN_VISIBLE, 0.5, 0.75, 0.9)  # lower ends of the bins of class accuracy by visible share
HANDLE_CLEARLY_VISIBLE = 0.04  # smallest share of a mug's visible points on its handle
ON_DISTRACTOR = 0.5  # a detection with more of its pixels on a distractor is a false positive there

Line = dict[str, Any]


def score_image(
    image: LabelledImage, found: Sequence[ObjectDetection], yaws: Sequence[float | None] | None = None
) -> Line:
    """Return ground truth and detections of one image as a line of results for JSON; masks are COCO RLE.

    Args:
        image: Rendered image with its labels.
        found: All detections, including those classified as 'other': they show what a missed object was
            taken for.
        yaws: Yaw of each detection in [rad], None where unknown; the mode of its distribution by default.
    """
    truth = [image.instances == index for index in range(len(image.labels))]
    overlaps = _overlaps(truth, [d.mask for d in found])
    objects, distractors = [], []
    for index, (label, mask) in enumerate(zip(image.labels, truth, strict=True)):
        if label.pixels == 0:
            continue
        visible = min(1.0, label.pixels / max(label.outline_pixels, 1.0))
        counts = bool(label.pixels >= MIN_PIXELS and visible >= MIN_VISIBLE)
        if label.category is None:
            shares = [(mask & d.mask).sum() / d.mask.sum() if is_accepted(d) else 0.0 for d in found]
            if counts:
                distractors.append(
                    {"pixels": label.pixels, "taken": bool(max(shares, default=0.0) > ON_DISTRACTOR)}
                )
            continue
        best = int(overlaps[index].argmax()) if found else -1
        iou = float(overlaps[index, best]) if found else 0.0
        entry: Line = {
            "category": label.category, "pixels": label.pixels, "visible": float(visible), "counts": counts,
            "iou": iou, "mask": encode_mask(mask), "found": None,
        }  # fmt: skip
        if iou > MIN_IOU:
            entry["found"] = found[best].category if is_accepted(found[best]) else "other"
            if label.category == "mug" and counts and len(found[best].yaw_probabilities):
                entry["yaw"] = _yaw(image, index, found[best], None if yaws is None else yaws[best])
        objects.append(entry)
    detections = [
        {"category": d.category, "score": d.score, "mask": encode_mask(d.mask)}
        for d in found
        if is_accepted(d)
    ]
    return {"objects": objects, "distractors": distractors, "detections": detections}


def is_accepted(detection: ObjectDetection) -> bool:
    """Return whether a class is more probable than 'other'."""
    p = detection.class_probabilities
    return len(p) != OTHER + 1 or int(np.argmax(p)) != OTHER


def _overlaps(
    truth: Sequence[Bool[np.ndarray, "h w"]], found: Sequence[Bool[np.ndarray, "h w"]]
) -> Float[np.ndarray, "t f"]:
    """Return the IoU of every pair of a true and a detected mask."""
    a = np.stack([m.ravel() for m in truth]).astype(np.float32) if truth else np.zeros((0, 1), np.float32)
    b = (
        np.stack([m.ravel() for m in found]).astype(np.float32)
        if found
        else np.zeros((0, a.shape[1]), np.float32)
    )
    common = a @ b.T
    return common / np.maximum(a.sum(1)[:, None] + b.sum(1)[None] - common, 1)


def _yaw(image: LabelledImage, index: int, found: ObjectDetection, known: float | None) -> Line:
    label = image.labels[index]
    points = points_of(image.frame, image.instances == index)
    yaw, mass = modes(found.yaw_probabilities, count=1)[0]
    return {
        "error": angle_between(yaw if known is None else known, label.yaw),
        "handle": handle_share(points, label.T_world_object),
        "entropy": entropy(found.yaw_probabilities),
        "mass": mass,
    }


def summarise_detection(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the metrics over all images; angles in radians, times in seconds."""
    objects = [entry for line in lines for entry in line["objects"] if entry["counts"]]
    matched = [entry for entry in objects if entry["found"] is not None]
    distractors = [entry for line in lines for entry in line["distractors"]]
    right = [entry for entry in matched if entry["found"] == entry["category"]]
    names = (*CATEGORIES, "other")
    confusion = [
        [sum(e["category"] == true and e["found"] == name for e in matched) for name in names]
        for true in CATEGORIES
    ]
    seconds = [line["seconds"] for line in lines if "seconds" in line]
    return {
        "images": len(lines),
        "objects": len(objects),
        "ap50": average_precision(lines, by_class=False)[0],
        "map50": average_precision(lines, by_class=True)[0],
        "map": average_precision(lines, by_class=True)[1],
        "recall": _share(len(matched), len(objects)),
        "mean_iou": float(np.mean([e["iou"] for e in matched])) if matched else 0.0,
        "class_accuracy": _share(len(right), len(matched)),
        "class_accuracy_by_visible": _by_visible(matched),
        "confusion": confusion,
        "distractors": len(distractors),
        "distractors_taken_for_objects": _share(sum(d["taken"] for d in distractors), len(distractors)),
        "yaw": _yaw_figures([e["yaw"] for e in matched if "yaw" in e]),
        "seconds": float(np.median(seconds)) if seconds else 0.0,
    }


def _by_visible(matched: Sequence[Mapping[str, Any]]) -> list[dict[str, float]]:
    """Return the class accuracy in bins of the visible share: occlusion makes single views ambiguous."""
    rows = []
    for low, high in zip(VISIBLE_SHARES, (*VISIBLE_SHARES[1:], np.inf)):
        chosen = [entry for entry in matched if low <= entry["visible"] < high]
        right = sum(entry["found"] == entry["category"] for entry in chosen)
        rows.append({"from": low, "objects": len(chosen), "class_accuracy": _share(right, len(chosen))})
    return rows


def _share(part: int, whole: int) -> float:
    return float(part / max(whole, 1))


def _yaw_figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    figures = {}
    for name, chosen in {
        "visible": [r for r in rows if r["handle"] >= HANDLE_VISIBLE],
        "clear": [r for r in rows if r["handle"] >= HANDLE_CLEARLY_VISIBLE],
        "hidden": [r for r in rows if r["handle"] < HANDLE_VISIBLE],
    }.items():
        errors = np.array([r["error"] for r in chosen] or [0.0])
        figures[name] = {
            "mugs": len(chosen),
            "median": float(np.median(errors)),
            "quantile_95": float(np.quantile(errors, 0.95)),
            "over_15_degrees": float((errors > np.radians(15)).mean()),
            "over_30_degrees": float((errors > np.radians(30)).mean()),
            "entropy": float(np.median([r["entropy"] for r in chosen] or [0.0])),
        }
    return figures


def average_precision(lines: Sequence[Mapping[str, Any]], by_class: bool) -> tuple[float, float]:
    """Return COCO's mask AP at IoU 0.5 and its mean over IoU 0.5 to 0.95; ignored objects are crowds.

    Args:
        lines: Results of ``score_image``.
        by_class: Whether to take the mean over classes; otherwise AP is class-agnostic.
    """
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    def number(name: str) -> int:
        return 1 + CATEGORIES.index(name) if by_class else 1  # type: ignore[arg-type]

    truth, results = [], []
    for image, line in enumerate(lines):
        for entry in line["objects"]:
            truth.append({
                "id": len(truth) + 1, "image_id": image, "category_id": number(entry["category"]),
                "segmentation": entry["mask"], "area": entry["pixels"], "bbox": [0, 0, 1, 1],
                "iscrowd": int(not entry["counts"]),
            })  # fmt: skip
        for entry in line["detections"]:
            results.append({
                "id": len(results) + 1, "image_id": image, "category_id": number(entry["category"]),
                "segmentation": entry["mask"], "score": entry["score"], "area": 1, "bbox": [0, 0, 1, 1],
                "iscrowd": 0,
            })  # fmt: skip
    if not truth or not results:
        return 0.0, 0.0
    categories = [{"id": k + 1, "name": str(k)} for k in range(len(CATEGORIES) if by_class else 1)]
    with contextlib.redirect_stdout(io.StringIO()):
        sides = []
        for annotations in (truth, results):
            side: Any = COCO()
            side.dataset = {
                "images": [{"id": k, "height": 1, "width": 1} for k in range(len(lines))],  # unused
                "categories": categories,
                "annotations": annotations,
            }
            side.createIndex()
            sides.append(side)
        evaluation = COCOeval(*sides, iouType="segm")
        evaluation.params.areaRng = [[0, 1e10]]
        evaluation.params.areaRngLbl = ["all"]
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][:, :, :, 0, -1]  # thresholds, recalls, classes
    valid = np.where(precision > -1, precision, np.nan)
    return float(np.nanmean(valid[0])), float(np.nanmean(valid))
