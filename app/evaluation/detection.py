"""``nodeslam evaluate detection``: masks, classes and yaw on rendered images of objects never trained on.

Images come in chunks, each with objects, textures and distractors of its own and from a seed of its own; a
finished chunk is one line of ``rows.jsonl``. The support plane is found in each image; the camera's pose
serves for the direction of yaw alone.
"""

from __future__ import annotations

import math
import time
from collections.abc import Hashable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from app.drawing import draw_detections
from app.errors import UsageError
from app.evaluation.detection_scoring import accepted, score_image, summarise_detection
from app.evaluation.jobs import Ledger, Line, spread
from app.options import EvaluateOptions
from app.runs.report import Report
from app.screen import Screen
from perception.detection.detector import Detector, DetectorConfig
from perception.inference.reconstruct import single_threaded_torch
from perception.io.files import write_atomically
from perception.io.scan_folder import png_bytes
from perception.pipeline import resolve_device
from perception.support_plane import fit_support_plane

ROWS = "rows.jsonl"
CHUNK = 20  # images
PICTURE = "detections.png"
_TILES = 4  # best and worst images in the picture


def run(options: EvaluateOptions, screen: Screen) -> Report:
    """Render and judge what is still to be done, and report on all."""
    begin = time.perf_counter()
    if options.images < 1:
        raise UsageError("evaluate detection needs an image at least; give --images")
    if options.renderer == "filament":
        from sim_assets.rendering.filament import require_filament

        require_filament()
    ledger, finished = Ledger.open(options, "evaluate-detection", ROWS, "chunk", _settings(options))
    chunks = range(math.ceil(options.images / CHUNK))
    to_do = [chunk for chunk in chunks if chunk not in finished]
    work = partial(run_chunk, options, ledger.folder.path)
    with screen.stage(f"{len(to_do)} chunks of {CHUNK} images"):
        for line in spread(work, to_do, options):
            finished[line["chunk"]] = line
            ledger.append(line)
            screen.update(f"{len(finished)} of {len(chunks)}")
    report = _report(options, finished, time.perf_counter() - begin)
    ledger.folder.write_report(report)
    _write_picture(ledger.folder.path)
    screen.show(detection_table(report.metrics))
    return report


def run_chunk(options: EvaluateOptions, folder: Path, chunk: int) -> Line:
    """Render a chunk of images, detect, and compare with the truth."""
    from sim_assets.datasets.training_scenes import TrainingScenes

    count = min(CHUNK, options.images - chunk * CHUNK)
    seed = int(np.random.SeedSequence([options.seed, chunk]).generate_state(1)[0])
    detector, lines = _detector(resolve_device(options.device)), []
    drawn: list[tuple[int, int, np.ndarray]] = []
    with single_threaded_torch(), TrainingScenes("test", seed, _scenes(options), _own(options)) as scenes:
        for number, image in enumerate(scenes.render(count)):
            plane = fit_support_plane([image.frame])
            start = time.process_time()
            found = detector(image.frame, plane)
            seconds = time.process_time() - start
            line = score_image(image, found) | {"seconds": seconds}
            lines.append(line)
            picture = draw_detections(image.frame, [d for d in found if accepted(d)], by_class=True)
            drawn = _extremes([*drawn, (_failures(line), number, picture)])
    for failures, number, picture in drawn:
        name = f"{failures:02d}_{chunk:03d}_{number:02d}.png"
        write_atomically(folder / "pictures" / name, png_bytes(picture))
    return {"chunk": chunk, "images": lines}


def _scenes(options: EvaluateOptions) -> Any:
    """4 to 10 objects with 1 to 4 distractors, gaps down to contact, from 0.3 to 0.9 m and 28 degrees up."""
    from sim_assets.datasets.table_top import TrainingSceneConfig
    from sim_assets.rendering.depth_noise import DEPTH_NOISES

    none, gaussian, realsense = (float(noise == options.depth_noise) for noise in DEPTH_NOISES)
    return TrainingSceneConfig(
        width=640, height=480, pool=24, distractors=12, objects=(4, 10), extras=(1, 4),
        distance=(0.3, 0.9), elevation=(math.radians(28), math.radians(90)),
        pictures_per_pool=CHUNK, pictures_per_texture=5, renderer=options.renderer,
        noises=(none, gaussian, realsense),
    )  # fmt: skip


def _own(options: EvaluateOptions) -> list[Any]:
    """(class, mesh) of the user's objects."""
    if options.object_meshes is None:
        return []
    from sim_assets.objects.user import load_user_mesh, mesh_files

    return [
        (category, load_user_mesh(path, category)) for path, category in mesh_files(options.object_meshes)
    ]


@cache
def _detector(device: str) -> Detector:
    """Keeps what is most probably of no class, so that its fate can be told."""
    return Detector.load(device, config=DetectorConfig(max_other=1.0))


def _failures(line: Mapping[str, Any]) -> int:
    """Objects not found or taken for something else, and distractors taken for objects."""
    wrong = sum(entry["counts"] and entry["found"] != entry["category"] for entry in line["objects"])
    return wrong + sum(entry["taken"] for entry in line["distractors"])


def _extremes(drawn: list[tuple[int, int, np.ndarray]]) -> list[tuple[int, int, np.ndarray]]:
    """The pictures with the fewest and with the most failures."""
    ordered = sorted(drawn, key=lambda entry: entry[:2])
    return ordered if len(ordered) <= 2 else [ordered[0], ordered[-1]]


def _write_picture(folder: Path) -> None:
    """The images with the fewest and with the most failures, side by side."""
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
    """What has to be the same in a resumed evaluation."""
    names = ("seed", "images", "renderer", "depth_noise", "object_meshes", "device")
    return {name: str(getattr(options, name)) for name in names}


def _report(options: EvaluateOptions, chunks: Mapping[Hashable, Line], seconds: float) -> Report:
    lines = [line for chunk in chunks.values() for line in chunk["images"]]
    return Report(
        command="evaluate detection",
        seed=options.seed,
        success=len(lines) == options.images,
        reason=f"{len(lines)} of {options.images} images",
        timings={"total": seconds},
        metrics=summarise_detection(lines),
        settings=_settings(options),
    )


def detection_table(m: Mapping[str, Any]) -> Table:
    """The report's figures to look at."""
    table = Table(title=f"{m['objects']} objects and {m['distractors']} distractors in {m['images']} images")
    table.add_column("")
    table.add_column("", justify="right")
    visible, clear, hidden = m["yaw"]["visible"], m["yaw"]["clear"], m["yaw"]["hidden"]
    whole = m["class_accuracy_by_visible"][-1]
    rows: Sequence[tuple[str, str]] = (
        ("mask AP50, whatever the class", f"{m['ap50']:.3f}"),
        ("mask AP50, mean over classes", f"{m['map50']:.3f}"),
        ("mask AP, mean over classes", f"{m['map']:.3f}"),
        ("found (IoU over 0.5)", f"{m['recall']:.1%}"),
        ("mean IoU of the found", f"{m['mean_iou']:.3f}"),
        ("class right, of the found", f"{m['class_accuracy']:.1%}"),
        (f"  {whole['from']:.0%} and more in view ({whole['objects']})", f"{whole['class_accuracy']:.1%}"),
        ("distractors taken for objects", f"{m['distractors_taken_for_objects']:.1%}"),
        (f"yaw, handle in view ({visible['mugs']}): median", f"{math.degrees(visible['median']):.1f}°"),
        ("  over 15°", f"{visible['over_15_degrees']:.1%}"),
        (f"  in clear view ({clear['mugs']}): over 15°", f"{clear['over_15_degrees']:.1%}"),
        (f"yaw, handle hidden ({hidden['mugs']}): median", f"{math.degrees(hidden['median']):.0f}°"),
        ("entropy in view, hidden [nat]", f"{visible['entropy']:.2f}, {hidden['entropy']:.2f}"),
        ("CPU time for an image", f"{1000 * m['seconds']:.0f} ms"),
    )
    for row in rows:
        table.add_row(*row)
    return table
