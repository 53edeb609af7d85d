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
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from perception.errors import InvalidInputError
from perception.io.detections import MAX_PER_IMAGE, read_detections, write_detections
from perception.io.files import read_json, write_atomically, write_json
from perception.io.images import DEPTH_MODES, png_bytes, read_image
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame

logger = logging.getLogger(__name__)

DEPTH_SCALE = 0.1  # of the depth images written here: a tenth of a millimetre, up to 6.5 m
FRAME_PERIOD = 1 / 30  # [s] between images of a folder that keeps no times
MIN_TRANSLATION = 10.0  # [mm] length below which all translations together are suspicious
MAX_DISTANCE = 100.0  # [m] of a camera from the origin and from other cameras
MAX_IMAGES = 2000  # that are in memory together: 2 MB each at 640 x 480
MAX_SEQUENCE = 100_000  # that are read one at a time
MAX_NUMBER = 1e9  # of a camera: 1000 km in millimetres; larger ones overflow
MASK_FOLDERS = ("mask_visib", "mask")


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
        self._cameras[str(index)] = _camera_entry(frame)

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
    if posed:
        _check_spread(folder, frames)
    for problem in problems:
        logger.warning("image skipped: %s", problem)
    suspicion = _suspicion_of_metres(folder, [cameras[image_id] for image_id in frames]) if posed else None
    if suspicion is not None:
        problems.append(suspicion)
        logger.warning("%s", suspicion)
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
    return isinstance(camera, dict) and "cam_R_w2c" in camera


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
    return {int(key): entry for key, entry in entries.items()}


def _read_frame(folder: Path, image_id: int, camera: Any, posed: bool) -> RgbdFrame:
    where = f"{folder / 'scene_camera.json'}, image {image_id}"
    matrix = _numbers(camera, "cam_K", 9, where).reshape(3, 3)
    scale = float(_numbers(camera, "depth_scale", 1, where)[0])
    if not 0 < scale <= 1000:
        raise InvalidInputError(f"{where}: depth_scale {scale} must be in 0..1000 (millimetres per unit)")
    rgb = read_image(folder, _image_name(folder, "rgb", image_id), ("RGB",), "8-bit RGB")
    raw = read_image(folder, f"depth/{image_id:06d}.png", DEPTH_MODES, "16-bit grey")
    if raw.shape != rgb.shape[:2]:
        raise InvalidInputError(
            f"{folder / 'depth'}/{image_id:06d}.png is {raw.shape[1]}x{raw.shape[0]} but the colour image is "
            f"{rgb.shape[1]}x{rgb.shape[0]}: register depth to colour"
        )
    time = camera.get("time", image_id * FRAME_PERIOD)
    if type(time) not in (int, float) or not math.isfinite(time):
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
        raise InvalidInputError(
            f"focal lengths {fx:g}, {fy:g} px are implausible for an image {width} px wide"
        )
    return CameraIntrinsics(width, height, fx, fy, cx, cy)


def _camera_pose(camera: Any, where: str) -> np.ndarray:
    """Return T_world_camera from BOP's world-to-camera rotation and translation in millimetres."""
    if "cam_R_w2c" not in camera or "cam_t_w2c" not in camera:
        raise InvalidInputError(f"{where}: has no pose although other images have; give all or none")
    R_camera_world = _numbers(camera, "cam_R_w2c", 9, where).reshape(3, 3)
    t_camera_world = _numbers(camera, "cam_t_w2c", 3, where) / 1000
    if (
        not np.allclose(R_camera_world @ R_camera_world.T, np.eye(3), atol=1e-3)
        or np.linalg.det(R_camera_world) < 0
    ):
        raise InvalidInputError(f"{where}: cam_R_w2c is not a rotation matrix")
    u, _, vt = np.linalg.svd(R_camera_world)  # nearest rotation: files hold rounded numbers
    T = np.eye(4)
    T[:3, :3] = (u @ vt).T
    T[:3, 3] = -T[:3, :3] @ t_camera_world
    distance = float(np.linalg.norm(T[:3, 3]))
    if distance > MAX_DISTANCE:
        raise InvalidInputError(
            f"{where}: cam_t_w2c puts the camera {distance:.3g} m from the origin, at most "
            f"{MAX_DISTANCE:g} m are allowed: give millimetres, in coordinates of the scene, not of a map"
        )
    return T


def _check_spread(folder: Path, frames: Mapping[int, RgbdFrame]) -> None:
    """Raise InvalidInputError if a camera is too far from the first for both to show one scene."""
    (first, T_first), *others = [(i, frame.T_world_camera) for i, frame in frames.items()]
    for image_id, T in others:
        assert T is not None and T_first is not None
        distance = float(np.linalg.norm(T[:3, 3] - T_first[:3, 3]))
        if distance > MAX_DISTANCE:
            raise InvalidInputError(
                f"{folder / 'scene_camera.json'}: cam_t_w2c puts the cameras of images {first} and "
                f"{image_id} {distance:.3g} m apart, at most {MAX_DISTANCE:g} m are allowed: "
                "give all in millimetres of one world frame"
            )


def _suspicion_of_metres(folder: Path, cameras: Sequence[Any]) -> str | None:
    """Return a warning if the translations are so small that they are probably in metres."""
    translations = [np.asarray(camera["cam_t_w2c"], dtype=np.float64).ravel() for camera in cameras]
    longest = max(float(np.linalg.norm(translation)) for translation in translations)
    if not 0 < longest < MIN_TRANSLATION:  # 0: the world is the camera frame
        return None
    return (
        f"{folder / 'scene_camera.json'}: the translations cam_t_w2c are at most {longest:.3g} mm long, "
        "probably they are in metres: multiply them by 1000"
    )


def _numbers(camera: Any, key: str, count: int, where: str) -> np.ndarray:
    value = camera.get(key) if isinstance(camera, dict) else None
    try:
        numbers = np.asarray(value).ravel()
    except ValueError:  # ragged lists
        numbers = np.zeros(0)
    if numbers.dtype.kind not in "if":  # texts, true and false
        numbers = np.zeros(0)
    numbers = numbers.astype(np.float64)
    if numbers.size != count or not (np.abs(numbers) <= MAX_NUMBER).all():  # NaN fails as well
        what = "a finite number" if count == 1 else f"{count} finite numbers"
        raise InvalidInputError(f"{where}: {key} must be {what} of at most {MAX_NUMBER:g} in magnitude")
    return numbers


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
