"""``nodeslam evaluate detection``: masks, classes and yaw on rendered images of the test families.

Images are rendered in chunks, each with its own seed, objects, textures and distractors; a finished chunk is
one line of ``rows.jsonl``. The support plane is fitted to each image; the camera pose is used only to express
yaw in the world frame. With ``--fits`` each detection is also reconstructed and judged by the evidence of its
fit, as ``nodeslam reconstruct`` does.
"""

from __future__ import annotations

import math
import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from app.drawing import draw_detections
from app.errors import UsageError
from app.evaluation.detection_fits import judged_by_fits
from app.evaluation.detection_scoring import is_accepted, score_image, summarise_detection
from app.evaluation.ledger import Ledger, LedgerFormat, Line
from app.jobs import Failure, Jobs, run_jobs
from app.options import EvaluateOptions
from app.runs.report import Report
from app.screen import Screen
from app.training.scene_dataset import training_scene_config
from perception.detection.detector import Detector, DetectorConfig
from perception.inference.acceptance import AcceptanceModel, shipped_acceptance
from perception.io.files import write_atomically
from perception.io.images import png_bytes
from perception.pipeline import Device, load_decoder, resolve_device
from perception.shape.decoder import ShapeDecoder
from perception.support_plane import fit_support_plane
from perception.threads import single_threaded

if TYPE_CHECKING:
    from sim_assets.datasets.scene_config import TrainingSceneConfig

ROWS = "rows.jsonl"
CHUNK = 20  # images per chunk
PICTURE = "detections.png"
_TILES = 4  # images with the fewest and with the most errors in the picture


def run(options: EvaluateOptions, screen: Screen) -> Report:
    """Evaluate the chunks that are not finished yet and report on all of them."""
    begin = time.perf_counter()
    if options.images < 1:
        raise UsageError("evaluate detection needs at least one image: give --images 1 or more")
    if options.renderer == "filament":
        from sim_assets.rendering.filament import require_filament

        require_filament()
    ledger, finished = Ledger.open(options, _format(options), _settings(options))
    chunks = range(math.ceil(options.images / CHUNK))
    to_do = [chunk for chunk in chunks if chunk not in finished]
    jobs = Jobs(to_do, partial(run_chunk, options, ledger.folder.path), failed_chunk)
    with screen.stage(f"{len(to_do)} chunks of {CHUNK} images"):
        for line in run_jobs(jobs, options):
            finished[line["chunk"]] = line
            ledger.append(line)
            screen.update(f"{len(finished)} of {len(chunks)}")
    report = _report(options, finished, time.perf_counter() - begin)
    ledger.folder.write_report(report)
    _write_picture(ledger.folder.path)
    screen.show(detection_table(report.metrics))
    return report


def run_chunk(options: EvaluateOptions, folder: Path, chunk: int) -> Line:
    """Render a chunk of images of the test families, detect, and compare with the ground truth."""
    from sim_assets.datasets.training_scenes import TrainingScenes

    count = _image_count(options, chunk)
    seed = int(np.random.SeedSequence([options.seed, chunk]).generate_state(1)[0])
    detector, lines = _detector(resolve_device(options.device)), []
    pictures: list[tuple[int, int, np.ndarray]] = []
    scene_config, meshes = _scene_config(options), _user_meshes(options)
    with single_threaded(), TrainingScenes("test", seed, scene_config, meshes) as scenes:
        for number, image in enumerate(scenes.render(count)):
            plane = fit_support_plane([image.frame])
            start = time.process_time()
            found = detector(image.frame, plane)
            seconds = time.process_time() - start
            yaws = None
            if options.fits:
                found, yaws = judged_by_fits(image.frame, found, plane, *_shape_models(options.device))
            line = score_image(image, found, yaws) | {"seconds": seconds}
            lines.append(line)
            picture = draw_detections(image.frame, [d for d in found if is_accepted(d)], by_class=True)
            pictures = _best_and_worst([*pictures, (_count_errors(line), number, picture)])
    for errors, number, picture in pictures:
        name = f"{errors:02d}_{chunk:03d}_{number:02d}.png"
        write_atomically(folder / "pictures" / name, png_bytes(picture))
    return {"chunk": chunk, "images": lines}


def failed_chunk(chunk: int, failure: Failure) -> Line:
    """Return the line of a chunk whose evaluation failed: its images are missing from the metrics."""
    return {"chunk": chunk, "images": [], "failed": failure.reason}


def _image_count(options: EvaluateOptions, chunk: int) -> int:
    return min(CHUNK, options.images - chunk * CHUNK)


def _format(options: EvaluateOptions) -> LedgerFormat:
    def check(line: Line) -> None:
        expected = 0 if "failed" in line else _image_count(options, line["chunk"])
        if len(line["images"]) != expected:
            raise ValueError(f"{len(line['images'])} of {expected} images")
        summarise_detection(line["images"])

    return LedgerFormat("evaluate-detection", ROWS, "chunk", check)


def _scene_config(options: EvaluateOptions) -> TrainingSceneConfig:
    """Return the configuration of the rendered scenes.

    4 to 10 objects and 1 to 4 distractors with gaps down to contact, seen from 0.3 to 0.9 m at elevations of
    at least 28 degrees; or, with ``rooms``, the distribution of the training scenes without lying objects.
    """
    from sim_assets.datasets.scene_config import TrainingSceneConfig
    from sim_assets.rendering.depth_noise import DEPTH_NOISES

    config = TrainingSceneConfig(
        width=640, height=480, pool=24, distractors=12, objects=(4, 10), extras=(1, 4),
        distance=(0.3, 0.9), elevation=(math.radians(28), math.radians(90)),
    )  # fmt: skip
    if options.rooms:
        config = replace(training_scene_config(), toppled=0.0)
    return replace(
        config, pictures_per_pool=CHUNK, pictures_per_texture=5, renderer=options.renderer,
        noises=tuple(float(noise == options.depth_noise) for noise in DEPTH_NOISES),
    )  # fmt: skip


def _user_meshes(options: EvaluateOptions) -> list[Any]:
    """Return (class, mesh) of each user object."""
    if options.object_meshes is None:
        return []
    from sim_assets.objects.user import load_user_mesh, mesh_files

    return [
        (category, load_user_mesh(path, category)) for path, category in mesh_files(options.object_meshes)
    ]


@cache
def _detector(device: str) -> Detector:
    """Return the detector without suppression of distractors, so that misclassified objects are counted."""
    return Detector.load(device, config=DetectorConfig(max_other=1.0))


@cache
def _shape_models(device: Device) -> tuple[ShapeDecoder, AcceptanceModel]:
    """Return the shape prior and the model that judges fits."""
    return load_decoder(device), shipped_acceptance()


def _count_errors(line: Mapping[str, Any]) -> int:
    """Return the number of missed or misclassified objects and of distractors taken for objects."""
    wrong = sum(entry["counts"] and entry["found"] != entry["category"] for entry in line["objects"])
    return wrong + sum(entry["taken"] for entry in line["distractors"])


def _best_and_worst(pictures: list[tuple[int, int, np.ndarray]]) -> list[tuple[int, int, np.ndarray]]:
    """Return the pictures with the fewest and with the most errors."""
    ordered = sorted(pictures, key=lambda entry: entry[:2])
    return ordered if len(ordered) <= 2 else [ordered[0], ordered[-1]]


def _write_picture(folder: Path) -> None:
    """Write the images with the fewest errors above those with the most."""
    import cv2

    paths = sorted((folder / "pictures").glob("*.png"))
    if len(paths) < 2 * _TILES:
        return
    rows = []
    for chosen in (paths[:_TILES], paths[-_TILES:]):
        images = [cv2.imread(str(path)) for path in chosen]
        rows.append(np.concatenate([image[::2, ::2] for image in images if image is not None], axis=1))
    picture = np.concatenate(rows)[..., ::-1]
    write_atomically(folder / PICTURE, png_bytes(np.ascontiguousarray(picture)))


def _settings(options: EvaluateOptions) -> dict[str, Any]:
    """Return the options that must not change when an evaluation is resumed."""
    names = ("seed", "images", "renderer", "depth_noise", "object_meshes", "device")
    settings = {name: str(getattr(options, name)) for name in names}
    return settings | {name: "True" for name in ("rooms", "fits") if getattr(options, name)}


def _report(options: EvaluateOptions, chunks: Mapping[Hashable, Line], seconds: float) -> Report:
    lines = [line for chunk in chunks.values() for line in chunk["images"]]
    failed = [f"chunk {number}: {chunk['failed']}" for number, chunk in chunks.items() if "failed" in chunk]
    return Report(
        command="evaluate detection",
        seed=options.seed,
        success=len(lines) == options.images,
        reason=f"{len(lines)} of {options.images} images"
        + (f", {len(failed)} chunks failed" if failed else ""),
        timings={"total": seconds},
        metrics=summarise_detection(lines),
        warnings=failed,
        settings=_settings(options),
    )


def detection_table(m: Mapping[str, Any]) -> Table:
    """Return the metrics as a table for the screen."""
    table = Table(title=f"{m['objects']} objects and {m['distractors']} distractors in {m['images']} images")
    table.add_column("")
    table.add_column("", justify="right")
    visible, clear, hidden = m["yaw"]["visible"], m["yaw"]["clear"], m["yaw"]["hidden"]
    unoccluded = m["class_accuracy_by_visible"][-1]
    unoccluded_label = f"  at least {unoccluded['from']:.0%} visible ({unoccluded['objects']})"
    rows: Sequence[tuple[str, str]] = (
        ("mask AP50, class-agnostic", f"{m['ap50']:.3f}"),
        ("mask AP50, mean over classes", f"{m['map50']:.3f}"),
        ("mask AP, mean over classes", f"{m['map']:.3f}"),
        ("recall (IoU over 0.5)", f"{m['recall']:.1%}"),
        ("mean IoU of matched objects", f"{m['mean_iou']:.3f}"),
        ("class accuracy of matched objects", f"{m['class_accuracy']:.1%}"),
        (unoccluded_label, f"{unoccluded['class_accuracy']:.1%}"),
        ("distractors taken for objects", f"{m['distractors_taken_for_objects']:.1%}"),
        (f"yaw, handle visible ({visible['mugs']}): median error", f"{math.degrees(visible['median']):.1f}°"),
        ("  error over 15°", f"{visible['over_15_degrees']:.1%}"),
        (f"  clearly visible ({clear['mugs']}): error over 15°", f"{clear['over_15_degrees']:.1%}"),
        (f"yaw, handle hidden ({hidden['mugs']}): median error", f"{math.degrees(hidden['median']):.0f}°"),
        ("yaw entropy, handle visible, hidden [nat]", f"{visible['entropy']:.2f}, {hidden['entropy']:.2f}"),
        ("CPU time per image", f"{1000 * m['seconds']:.0f} ms"),
    )
    for row in rows:
        table.add_row(*row)
    return table
