"""Scan folders: RGB-D images with camera poses on disk, in the layout of a BOP scene.

    rgb/000000.png         8-bit colour; .jpg as well
    depth/000000.png       uint16; times ``depth_scale`` = millimetres; 0 = no measurement
    scene_camera.json      per image id: cam_K, depth_scale; cam_R_w2c, cam_t_w2c [mm] where known
    detections.json        optional; COCO results with run-length masks, plus ``instance_id`` across images
    mask_visib/, mask/     optional; <image>_<number>.png, white where an object is, of a class unknown

See https://github.com/thodan/bop_toolkit, docs/bop_datasets_format.md.
"""

from __future__ import annotations

import io
import logging
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from PIL import Image

from perception.errors import InvalidInputError
from perception.io.detections import read_detections, write_detections
from perception.io.files import read_json, write_atomically, write_json
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame

_log = logging.getLogger(__name__)

DEPTH_SCALE = 0.1  # of the depth images written here: a tenth of a millimetre, up to 6.5 m
FRAME_PERIOD = 1 / 30  # [s] between images of a folder that keeps no times
MAX_IMAGE_SIDE = 8192
MASK_FOLDERS = ("mask_visib", "mask")


@dataclass(frozen=True)
class Scan:
    """What a scan folder holds.

    Attributes:
        frames: the readable images, by ascending id.
        detections: for each frame its detections, or None where the folder has none.
        masks: for each frame masks of objects whose class nobody has told, or None where the folder has none.
        image_ids: the id of each frame in the folder.
        warnings: one line for each image that was left out, naming it and what is wrong.
    """

    frames: tuple[RgbdFrame, ...]
    detections: tuple[tuple[ObjectDetection, ...], ...] | None
    image_ids: tuple[int, ...]
    warnings: tuple[str, ...] = ()
    masks: tuple[tuple[Bool[np.ndarray, "_h _w"], ...], ...] | None = None

    @property
    def has_poses(self) -> bool:
        return all(frame.T_world_camera is not None for frame in self.frames)


def write_scan(
    folder: str | Path,
    frames: Sequence[RgbdFrame],
    detections: Sequence[Sequence[ObjectDetection]] | None = None,
) -> None:
    """Write frames, and detections where given (one sequence for each frame), as a scan folder.

    ``scene_camera.json`` is written last, so a folder that has one is complete.
    """
    writer = ScanWriter(Path(folder))
    for frame in frames:
        writer.add(frame)
    if detections is not None:
        write_detections(folder, detections)
    writer.close()


class ScanWriter:
    """Writes a scan folder image by image; ``close`` makes it one."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._cameras: dict[str, Any] = {}

    def add(self, frame: RgbdFrame) -> None:
        """Writes the next image."""
        index = len(self._cameras)
        raw = np.rint(np.asarray(frame.depth, np.float64) * (1000 / DEPTH_SCALE))
        raw[raw > np.iinfo(np.uint16).max] = 0  # beyond what 16 bits hold: not measured
        write_atomically(self.folder / "rgb" / f"{index:06d}.png", png_bytes(frame.rgb))
        write_atomically(self.folder / "depth" / f"{index:06d}.png", png_bytes(raw.astype(np.uint16)))
        self._cameras[str(index)] = _camera_entry(frame)

    def close(self) -> None:
        """Writes ``scene_camera.json``."""
        write_json(self.folder / "scene_camera.json", self._cameras)


def read_scan(folder: str | Path) -> Scan:
    """Read a scan folder; an image that cannot be used is left out with a warning that names it.

    Raises:
        InvalidInputError: the folder has no usable image, or one of its JSON files is bad; the message
            names the file, what is wrong and what to do.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InvalidInputError(
            f"{folder} is not a folder: give the scan folder that holds scene_camera.json"
        )
    cameras = _read_cameras(folder)
    # A pose of the first image alone only says where a sequence begins.
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
        _log.warning("image left out: %s", problem)
    detections = read_detections(folder, frames, set(cameras))
    masks = read_masks(folder, frames) if detections is None else None
    return Scan(tuple(frames.values()), detections, tuple(frames), tuple(problems), masks)


def read_masks(
    folder: Path, frames: dict[int, RgbdFrame]
) -> tuple[tuple[Bool[np.ndarray, "_h _w"], ...], ...] | None:
    """Masks from ``mask_visib/`` (only what is visible), else ``mask/``; None where there is neither.

    Raises:
        InvalidInputError: a mask is unreadable, or of another size than its image.
    """
    kind = next((kind for kind in MASK_FOLDERS if (folder / kind).is_dir()), None)
    if kind is None:
        return None
    found: dict[int, list[np.ndarray]] = {image_id: [] for image_id in frames}
    for path in sorted((folder / kind).glob("*.png")):
        number, _, rest = path.stem.partition("_")
        if not (number.isdigit() and rest):
            raise InvalidInputError(
                f"{path}: masks are named <image>_<number>.png, such as 000000_000001.png"
            )
        if int(number) not in frames:
            continue
        mask = read_png(folder, f"{kind}/{path.name}", ("L", "1", "P"), "8-bit grey") > 0
        if mask.shape != frames[int(number)].depth.shape:
            size = frames[int(number)].depth.shape[::-1]
            raise InvalidInputError(
                f"{path} is {mask.shape[1]}x{mask.shape[0]} but its image is {size[0]}x{size[1]}"
            )
        if mask.any():
            found[int(number)].append(mask)
    return tuple(tuple(masks) for masks in found.values())


@dataclass(frozen=True)
class ScanIndex:
    """A scan folder whose images are read one at a time: for sequences too long to be held in memory."""

    folder: Path
    cameras: dict[int, Any]

    @staticmethod
    def of(folder: Path) -> ScanIndex:
        """Reads ``scene_camera.json``; raises InvalidInputError as ``read_scan`` does."""
        return ScanIndex(folder, _read_cameras(folder))

    @property
    def ids(self) -> list[int]:
        return sorted(self.cameras)

    def read(self, image_id: int) -> RgbdFrame:
        """One image, with its pose where it has one; InvalidInputError names what is wrong with it."""
        camera = self.cameras[image_id]
        return _read_frame(self.folder, image_id, camera, _has_pose(camera))


def _image_name(folder: Path, kind: str, image_id: int) -> str:
    """Of the file that is there; PNG where there is none, to be asked for by that name."""
    names = [f"{kind}/{image_id:06d}.{suffix}" for suffix in ("png", "jpg", "jpeg", "JPG")]
    return next((name for name in names if (folder / name).exists()), names[0])


def _has_pose(camera: Any) -> bool:
    return isinstance(camera, dict) and "cam_R_w2c" in camera


def _read_cameras(folder: Path) -> dict[int, Any]:
    path = folder / "scene_camera.json"
    remedy = "a scan folder needs it, with cam_K and depth_scale for each image id"
    if (folder / "scan" / path.name).is_file():  # a run folder keeps its images in one
        remedy = f"the scan folder is {folder / 'scan'}"
    entries = read_json(path, remedy)
    if not isinstance(entries, dict) or not entries:
        raise InvalidInputError(f"{path} must map image ids to cameras, at least one")
    for key in entries:
        if not (key.isascii() and key.isdigit() and len(key) <= 9):
            raise InvalidInputError(f"{path}: image id '{key}' is not a number; ids name the image files")
    return {int(key): entry for key, entry in entries.items()}


def _read_frame(folder: Path, image_id: int, camera: Any, posed: bool) -> RgbdFrame:
    where = f"{folder / 'scene_camera.json'}, image {image_id}"
    matrix = _numbers(camera, "cam_K", 9, where).reshape(3, 3)
    scale = float(_numbers(camera, "depth_scale", 1, where)[0])
    if not 0 < scale <= 1000:
        raise InvalidInputError(f"{where}: depth_scale {scale} must be in 0..1000 (millimetres per unit)")
    rgb = read_png(folder, _image_name(folder, "rgb", image_id), ("RGB",), "8-bit RGB")
    raw = read_png(folder, f"depth/{image_id:06d}.png", ("I;16", "I;16B", "I"), "16-bit grey")
    if raw.shape != rgb.shape[:2]:
        raise InvalidInputError(
            f"{folder / 'depth'}/{image_id:06d}.png is {raw.shape[1]}x{raw.shape[0]} but the colour image is "
            f"{rgb.shape[1]}x{rgb.shape[0]}: register depth to colour"
        )
    time = camera.get("time", image_id * FRAME_PERIOD)
    if not isinstance(time, int | float) or not math.isfinite(time):
        raise InvalidInputError(f"{where}: time must be seconds, got {time!r}")
    try:
        return RgbdFrame(
            time=float(time),
            rgb=rgb,
            depth=(raw * (scale / 1000)).astype(np.float32),
            intrinsics=_intrinsics(matrix, rgb.shape[1], rgb.shape[0]),
            T_world_camera=_camera_pose(camera, where) if posed else None,
        )
    except InvalidInputError as error:
        message = str(error)
        raise InvalidInputError(message if message.startswith(where) else f"{where}: {message}") from None


def _intrinsics(matrix: np.ndarray, width: int, height: int) -> CameraIntrinsics:
    fx, skew, cx, below, fy, cy = matrix[:2].ravel()
    if skew != 0 or below != 0 or tuple(matrix[2]) != (0, 0, 1):
        raise InvalidInputError(
            "cam_K must be [fx, 0, cx, 0, fy, cy, 0, 0, 1]: undistort and rectify the images"
        )
    if not (0.05 * width < fx < 50 * width and 0.5 < fx / max(fy, 1e-9) < 2):
        raise InvalidInputError(f"focal lengths {fx:g}, {fy:g} px are absurd for an image {width} px wide")
    return CameraIntrinsics(width, height, fx, fy, cx, cy)


def _camera_pose(camera: Any, where: str) -> np.ndarray:
    """T_world_camera [m] from BOP's world-to-camera rotation and translation in millimetres."""
    if "cam_R_w2c" not in camera or "cam_t_w2c" not in camera:
        raise InvalidInputError(f"{where}: has no pose although other images have; give all or none")
    R_camera_world = _numbers(camera, "cam_R_w2c", 9, where).reshape(3, 3)
    t_camera_world = _numbers(camera, "cam_t_w2c", 3, where) / 1000
    if (
        not np.allclose(R_camera_world @ R_camera_world.T, np.eye(3), atol=1e-3)
        or np.linalg.det(R_camera_world) < 0
    ):
        raise InvalidInputError(f"{where}: cam_R_w2c is not a rotation matrix")
    u, _, vt = np.linalg.svd(R_camera_world)  # rounded numbers made orthonormal again
    T = np.eye(4)
    T[:3, :3] = (u @ vt).T
    T[:3, 3] = -T[:3, :3] @ t_camera_world
    return T


def _numbers(camera: Any, key: str, count: int, where: str) -> np.ndarray:
    value = camera.get(key) if isinstance(camera, dict) else None
    try:
        numbers = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    if numbers.size != count or not np.isfinite(numbers).all():
        what = "a finite number" if count == 1 else f"{count} finite numbers"
        raise InvalidInputError(f"{where}: {key} must be {what}")
    return numbers


def read_png(folder: Path, name: str, modes: tuple[str, ...], wanted: str) -> np.ndarray:
    """An image of a folder by its name in it, checked: of the wanted kind, whole, and inside the folder.

    Raises:
        InvalidInputError: naming the file, what is wrong and what to do.
    """
    path = folder / name
    kind = "PNG" if path.suffix == ".png" else "JPEG"
    if not path.exists():
        raise InvalidInputError(f"{path} is missing: add it, or take it out of the folder's list of images")
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InvalidInputError(f"{path} leads out of the scan folder: copy the image into it")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            data = path.read_bytes()
            header = Image.open(io.BytesIO(data), formats=(kind,))
            mode, size = header.mode, header.size
            if mode not in modes:
                raise InvalidInputError(f"{path} must be {wanted}, its pixels are of type '{mode}'")
            if max(size) > MAX_IMAGE_SIDE:
                raise InvalidInputError(f"{path} is {size[0]}x{size[1]}; at most {MAX_IMAGE_SIDE} px a side")
            header.verify()  # checksums of every chunk
            pixels = np.asarray(Image.open(io.BytesIO(data), formats=(kind,)))
    except InvalidInputError:
        raise
    except Exception as error:  # the decoder raises a dozen kinds, struct.error and SyntaxError among them
        raise InvalidInputError(
            f"{path} is not a readable {kind} ({error}): record or copy it again"
        ) from None
    return pixels


def png_bytes(image: np.ndarray) -> bytes:
    """The image as a PNG file: (H, W, 3) uint8, or (H, W) uint8 or uint16."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", compress_level=3)
    return buffer.getvalue()


def _camera_entry(frame: RgbdFrame) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "cam_K": frame.intrinsics.matrix.ravel().tolist(),
        "depth_scale": DEPTH_SCALE,
        "time": float(frame.time),
    }
    if frame.T_world_camera is not None:
        T_camera_world = np.linalg.inv(frame.T_world_camera)
        entry["cam_R_w2c"] = T_camera_world[:3, :3].ravel().tolist()
        entry["cam_t_w2c"] = (1000 * T_camera_world[:3, 3]).tolist()
    return entry
