"""Detections of single images beside the truth, and what many images say together.

A thing counts from MIN_PIXELS visible pixels (at 640 x 480) and MIN_VISIBLE of its outline on; what shows
less is neither asked for nor held against anybody. A detection is one of an object when a class is more
probable than 'of no class'.
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
from perception.types import CATEGORIES, ObjectDetection

if TYPE_CHECKING:
    from sim_assets.datasets.table_top import LabelledImage

MIN_PIXELS = 300
MIN_VISIBLE = 0.25
OTHER = len(CATEGORIES)
MATCHED = 0.5  # IoU from which on a detection is one of the object
SHARES = (MIN_VISIBLE, 0.5, 0.75, 0.9)  # lower ends of the visible shares by which classes are counted
IN_CLEAR_VIEW = 0.04  # share of a mug's visible points on its handle from which on it is in clear view
ON_DISTRACTOR = 0.5  # share of a detection's pixels that lie on a distractor which is taken for an object

Line = dict[str, Any]


def score_image(image: LabelledImage, found: Sequence[ObjectDetection]) -> Line:
    """Truth and detections of one image as a line of results, ready for JSON; masks are run-length codes.

    ``found`` must hold doubtful detections, too: those that are most probably of no class say what became of
    an object that is not found.
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
            shares = [(mask & d.mask).sum() / d.mask.sum() if accepted(d) else 0.0 for d in found]
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
        if iou > MATCHED:
            entry["found"] = found[best].category if accepted(found[best]) else "other"
            if label.category == "mug" and counts and len(found[best].yaw_probabilities):
                entry["yaw"] = _yaw(image, index, found[best])
        objects.append(entry)
    detections = [
        {"category": d.category, "score": d.score, "mask": encode_mask(d.mask)} for d in found if accepted(d)
    ]
    return {"objects": objects, "distractors": distractors, "detections": detections}


def accepted(found: ObjectDetection) -> bool:
    """Whether a class is more probable than none."""
    p = found.class_probabilities
    return len(p) != OTHER + 1 or int(np.argmax(p)) != OTHER


def _overlaps(
    truth: Sequence[Bool[np.ndarray, "h w"]], found: Sequence[Bool[np.ndarray, "h w"]]
) -> Float[np.ndarray, "t f"]:
    """IoU of every pair."""
    a = np.stack([m.ravel() for m in truth]).astype(np.float32) if truth else np.zeros((0, 1), np.float32)
    b = (
        np.stack([m.ravel() for m in found]).astype(np.float32)
        if found
        else np.zeros((0, a.shape[1]), np.float32)
    )
    common = a @ b.T
    return common / np.maximum(a.sum(1)[:, None] + b.sum(1)[None] - common, 1)


def _yaw(image: LabelledImage, index: int, found: ObjectDetection) -> Line:
    label = image.labels[index]
    points = points_of(image.frame, image.instances == index)
    yaw, mass = modes(found.yaw_probabilities, count=1)[0]
    return {
        "error": angle_between(yaw, label.yaw),
        "handle": handle_share(points, label.T_world_object),
        "entropy": entropy(found.yaw_probabilities),
        "mass": mass,
    }


def summarise_detection(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures over images; angles in [rad], times in [s]."""
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
    """How often classes are right by how much of the object is seen: much hidden, one view cannot tell."""
    rows = []
    for low, high in zip(SHARES, (*SHARES[1:], np.inf)):
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
        "clear": [r for r in rows if r["handle"] >= IN_CLEAR_VIEW],
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
    """(at IoU 0.5, mean over 0.5 .. 0.95) of the masks as COCO counts it; what doesn't count is ignored.

    By class: the mean over classes; else whatever the class.
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
                "images": [{"id": k, "height": 1, "width": 1} for k in range(len(lines))],  # codes know
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
