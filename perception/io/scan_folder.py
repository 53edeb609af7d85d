"""Scan folders: RGB-D images with camera poses on disk, in the layout of a BOP scene.

    rgb/000000.png         8-bit colour; .jpg as well
    depth/000000.png       uint16; times ``depth_scale`` = millimetres; 0 = no measurement
    scene_camera.json      per image id: cam_K, depth_scale; cam_R_w2c, cam_t_w2c [mm] where known
    detections.json        optional; COCO results with run-length masks, plus ``instance_id`` across images
    mask_visib/, mask/     optional; <image>_<number>.png, white on one object of unknown class

See https://github.com/thodan/bop_toolkit, docs/bop_datasets_format.md.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from perception.errors import InvalidInputError
from perception.io.detections import MAX_PER_IMAGE, read_detections, write_detections
from perception.io.files import read_json, write_atomically, write_json
from perception.io.images import DEPTH_MODES, png_bytes, read_image
from perception.io.scan_cameras import (
    DEPTH_SCALE,
    MAX_TIME,
    camera_entry,
    read_intrinsics,
    read_numbers,
    read_pose,
    suspicion_of_metres,
)
from perception.types import ObjectDetection, RgbdFrame

logger = logging.getLogger(__name__)

FRAME_PERIOD = 1 / 30  # [s] between images of a folder that keeps no times
MAX_IMAGES = 2000  # that are in memory together: 2 MB each at 640 x 480
MAX_SEQUENCE = 100_000  # that are read one at a time
MASK_FOLDERS = ("mask_visib", "mask")
DEPTH_SCALES = (1e-3, 1e3)  # range of the millimetres per unit of depth images


@dataclass(frozen=True)
class Scan:
    """Content of a scan folder.

    Attributes:
        frames: Usable images by ascending id.
        detections: Detections of each frame; None without ``detections.json``.
        image_ids: Id of each frame in the folder.
        warnings: One line for each unusable image, naming it and the problem, and for suspicious poses.
        masks: Masks of objects of unknown class for each frame; None without mask folder or with detections.
    """

    frames: tuple[RgbdFrame, ...]
    detections: tuple[tuple[ObjectDetection, ...], ...] | None
    image_ids: tuple[int, ...]
    warnings: tuple[str, ...] = ()
    masks: tuple[tuple[Bool[np.ndarray, "_h _w"], ...], ...] | None = None

    @property
    def has_poses(self) -> bool:
        """Whether the camera pose of every frame is known."""
        return all(frame.T_world_camera is not None for frame in self.frames)


def write_scan(
    folder: str | Path,
    frames: Sequence[RgbdFrame],
    detections: Sequence[Sequence[ObjectDetection]] | None = None,
) -> None:
    """Write frames, and the detections of each frame if given, as a scan folder.

    ``scene_camera.json`` is written last, so a folder that has one is complete.
    """
    writer = ScanWriter(Path(folder))
    for frame in frames:
        writer.add(frame)
    if detections is not None:
        write_detections(folder, detections)
    writer.close()


class ScanWriter:
    """Writes a scan folder image by image; ``close`` completes it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._cameras: dict[str, Any] = {}

    def add(self, frame: RgbdFrame) -> None:
        """Write the next image."""
        index = len(self._cameras)
        raw = np.rint(np.asarray(frame.depth, np.float64) * (1000 / DEPTH_SCALE))
        raw[raw > np.iinfo(np.uint16).max] = 0  # exceeds 16 bits: marked as missing
        write_atomically(self.folder / "rgb" / f"{index:06d}.png", png_bytes(frame.rgb))
        write_atomically(self.folder / "depth" / f"{index:06d}.png", png_bytes(raw.astype(np.uint16)))
        self._cameras[str(index)] = camera_entry(frame)

    def close(self) -> None:
        """Write ``scene_camera.json``."""
        write_json(self.folder / "scene_camera.json", self._cameras)


def read_scan(folder: str | Path) -> Scan:
    """Read a scan folder; unusable images are skipped with a warning.

    Raises:
        InvalidInputError: The folder has no usable image, or a JSON file is invalid; the message names the
            file, the problem and the remedy.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InvalidInputError(
            f"{folder} is not a folder: give the scan folder that holds scene_camera.json"
        )
    cameras = _read_cameras(folder, MAX_IMAGES)
    # A pose of the first image only is the start of a sequence without poses.
    later = any(_has_pose(camera) for key, camera in cameras.items() if key != min(cameras))
    posed = later or (len(cameras) == 1 and any(map(_has_pose, cameras.values())))
    frames: dict[int, RgbdFrame] = {}
    problems: list[str] = []
    for image_id, camera in sorted(cameras.items()):
        try:
            frames[image_id] = _read_frame(folder, image_id, camera, posed)
        except InvalidInputError as error:
            problems.append(str(error))
    if not frames:
        raise InvalidInputError(problems[0])
    for problem in problems:
        logger.warning("image skipped: %s", problem)
    suspicion = suspicion_of_metres([cameras[image_id] for image_id in frames]) if posed else None
    if suspicion is not None:
        problems.append(f"{folder / 'scene_camera.json'}: {suspicion}")
        logger.warning("%s", problems[-1])
    detections = read_detections(folder, frames, set(cameras))
    masks = read_masks(folder, frames) if detections is None else None
    return Scan(tuple(frames.values()), detections, tuple(frames), tuple(problems), masks)


def read_masks(
    folder: Path, frames: dict[int, RgbdFrame]
) -> tuple[tuple[Bool[np.ndarray, "_h _w"], ...], ...] | None:
    """Read masks from ``mask_visib/`` (visible parts) or else ``mask/``; None if there is neither.

    Args:
        folder: Scan folder.
        frames: Usable images by id; masks of other images and empty masks are ignored.

    Raises:
        InvalidInputError: A mask is unreadable or differs in size from its image.
    """
    kind = next((kind for kind in MASK_FOLDERS if (folder / kind).is_dir()), None)
    if kind is None:
        return None
    found: dict[int, list[np.ndarray]] = {image_id: [] for image_id in frames}
    for path in sorted((folder / kind).glob("*.png")):
        number, _, rest = path.stem.partition("_")
        if not (number.isascii() and number.isdigit() and rest):
            raise InvalidInputError(
                f"{path}: masks are named <image>_<number>.png, such as 000000_000001.png"
            )
        if int(number) not in frames:
            continue
        mask = read_image(folder, f"{kind}/{path.name}", ("L", "1", "P"), "8-bit grey") > 0
        if mask.shape != frames[int(number)].depth.shape:
            size = frames[int(number)].depth.shape[::-1]
            raise InvalidInputError(
                f"{path} is {mask.shape[1]}x{mask.shape[0]} but its image is {size[0]}x{size[1]}"
            )
        if mask.any():
            found[int(number)].append(mask)
        if len(found[int(number)]) > MAX_PER_IMAGE:
            raise InvalidInputError(
                f"{folder / kind}: image {int(number)} has more than {MAX_PER_IMAGE} masks: "
                "keep the best ones"
            )
    return tuple(tuple(masks) for masks in found.values())


@dataclass(frozen=True)
class ScanIndex:
    """A scan folder whose images are read one at a time, for sequences that do not fit into memory.

    Attributes:
        folder: The scan folder.
        cameras: Entries of ``scene_camera.json`` by image id.
    """

    folder: Path
    cameras: dict[int, Any]

    @staticmethod
    def of(folder: Path) -> ScanIndex:
        """Read ``scene_camera.json``; raises InvalidInputError as ``read_scan``."""
        return ScanIndex(folder, _read_cameras(folder, MAX_SEQUENCE))

    @property
    def ids(self) -> list[int]:
        """Image ids in ascending order."""
        return sorted(self.cameras)

    def read(self, image_id: int) -> RgbdFrame:
        """Read one image, with its pose if known; raises InvalidInputError if it is unusable."""
        camera = self.cameras[image_id]
        return _read_frame(self.folder, image_id, camera, _has_pose(camera))


def _image_name(folder: Path, kind: str, image_id: int) -> str:
    """Return the relative path of the existing image file; that of the PNG if there is none."""
    names = [f"{kind}/{image_id:06d}.{suffix}" for suffix in ("png", "jpg", "jpeg", "JPG")]
    return next((name for name in names if (folder / name).exists()), names[0])


def _has_pose(camera: Any) -> bool:
    return isinstance(camera, dict) and not camera.keys().isdisjoint(("cam_R_w2c", "cam_t_w2c"))


def _read_cameras(folder: Path, max_images: int) -> dict[int, Any]:
    path = folder / "scene_camera.json"
    remedy = "a scan folder needs it, with cam_K and depth_scale for each image id"
    if (folder / "scan" / path.name).is_file():  # the folder is a run folder
        remedy = f"the scan folder is {folder / 'scan'}"
    entries = read_json(path, remedy)
    if not isinstance(entries, dict) or not entries:
        raise InvalidInputError(f"{path} must map image ids to cameras, at least one")
    if len(entries) > max_images:
        raise InvalidInputError(
            f"{path} lists {len(entries)} images, at most {max_images} are read: keep a part of them"
        )
    for key in entries:
        if not (key.isascii() and key.isdigit() and len(key) <= 9):
            raise InvalidInputError(f"{path}: image id '{key}' is not a number; ids name the image files")
    cameras = {int(key): entry for key, entry in entries.items()}
    if len(cameras) < len(entries):
        raise InvalidInputError(f"{path} lists an image twice: '1' and '01' are the same id")
    return cameras


def _read_frame(folder: Path, image_id: int, camera: Any, posed: bool) -> RgbdFrame:
    rgb = read_image(folder, _image_name(folder, "rgb", image_id), ("RGB",), "8-bit RGB")
    raw = read_image(folder, f"depth/{image_id:06d}.png", DEPTH_MODES, "16-bit grey")
    if raw.shape != rgb.shape[:2]:
        raise InvalidInputError(
            f"{folder / 'depth'}/{image_id:06d}.png is {raw.shape[1]}x{raw.shape[0]} but the colour image is "
            f"{rgb.shape[1]}x{rgb.shape[0]}: register depth to colour"
        )
    try:
        return RgbdFrame(
            intrinsics=read_intrinsics(camera, rgb.shape[1], rgb.shape[0]),
            time=_time(camera, image_id * FRAME_PERIOD),
            rgb=rgb,
            depth=(raw * (_depth_scale(camera) / 1000)).astype(np.float32),
            T_world_camera=read_pose(camera) if posed else None,
        )
    except InvalidInputError as error:
        raise InvalidInputError(f"{folder / 'scene_camera.json'}, image {image_id}: {error}") from None


def _depth_scale(camera: Any) -> float:
    """Return the millimetres per unit of the depth image."""
    scale = float(read_numbers(camera, "depth_scale", 1)[0])
    low, high = DEPTH_SCALES
    if not low <= scale <= high:
        raise InvalidInputError(f"depth_scale {scale:g} must be in {low:g}..{high:g} (millimetres per unit)")
    return scale


def _time(camera: Any, default: float) -> float:
    time = camera.get("time", default)
    if type(time) not in (int, float) or not abs(time) <= MAX_TIME:
        raise InvalidInputError(f"time must be seconds, got {time!r}")
    return float(time)
