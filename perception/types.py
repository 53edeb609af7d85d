"""Data types shared by all packages: frames, detections and object estimates, as frozen values.

Conventions: metres, radians, seconds. ``T_world_camera`` maps camera coordinates into the world and is the
camera's pose there. Cameras follow OpenCV (x right, y down, z forward). A depth of 0 is no measurement.
Objects live in a canonical frame (z up, origin at the centre of the occupancy grid, mug handle along +x);
``scale`` holds the metres per canonical unit along the object's axes, so that

    p_world = T_world_object @ (scale * p_canonical),    p_canonical in [-1, 1]^3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from perception.errors import InvalidInputError

Category = Literal["mug", "bowl", "bottle", "can"]
CATEGORIES: tuple[Category, ...] = get_args(Category)
OTHER = len(CATEGORIES)  # index of 'other' (distractors) in class probabilities
GRID_RESOLUTION = 32
CODE_SIZE = 16
_DIRECTIONS = 36  # in which the width of a bowl is measured
_TIP = 6e-5  # [m^2] section up to which the end of a mesh is a tip

FitStatus = Literal["converged", "not_converged", "implausible"]
FIT_STATUSES: tuple[FitStatus, ...] = get_args(FitStatus)
RestingPose = Literal["upright", "lying", "upside-down"]
RESTING_POSES: tuple[RestingPose, ...] = get_args(RestingPose)
# Resting poses of each class that networks tell apart: a can upside down looks like an upright one.
POSES_OF: Mapping[Category, tuple[RestingPose, ...]] = {
    "mug": ("upright", "upside-down", "lying"),
    "bowl": ("upright", "upside-down"),
    "bottle": ("upright", "lying"),
    "can": ("upright", "lying"),
}
PosedClass = tuple[Category, RestingPose]
POSED_CLASSES: tuple[PosedClass, ...] = tuple((c, pose) for c in CATEGORIES for pose in POSES_OF[c])


def _frozen(array: np.ndarray, dtype: type | None = None) -> np.ndarray:
    """Return a read-only view of the array, cast if requested; the caller's array stays writable."""
    view = np.asarray(array, dtype=dtype).view()
    view.flags.writeable = False
    return view


def _require(condition: bool | np.bool_, message: str) -> None:
    if not condition:
        raise InvalidInputError(message)


def check_rigid(T: np.ndarray, name: str) -> np.ndarray:
    """Return the transform as a read-only float64 array.

    Raises:
        InvalidInputError: It is not a finite (4, 4) rigid motion.
    """
    T = np.asarray(T, dtype=np.float64)
    _require(T.shape == (4, 4) and bool(np.isfinite(T).all()), f"{name} must be a finite 4x4 matrix")
    rotation = T[:3, :3]
    rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0
    _require(
        rigid and np.allclose(T[3], (0, 0, 0, 1)), f"{name} must be a rigid motion (rotation, translation)"
    )
    return _frozen(T)


@dataclass(frozen=True)
class CameraIntrinsics:
    """Pinhole camera without distortion: (u, v) = (fx x/z + cx, fy y/z + cy), pixel centres at integers."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        _require(
            self.width > 0 and self.height > 0, f"image size {self.width}x{self.height} must be positive"
        )
        numbers = (self.fx, self.fy, self.cx, self.cy)
        _require(bool(np.isfinite(numbers).all()), f"camera intrinsics {numbers} must be finite")
        _require(self.fx > 0 and self.fy > 0, f"focal lengths {self.fx}, {self.fy} px must be positive")
        inside = -self.width <= self.cx <= 2 * self.width and -self.height <= self.cy <= 2 * self.height
        _require(inside, f"principal point ({self.cx}, {self.cy}) is far outside the image")

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)


@dataclass(frozen=True, eq=False)  # equal if it is the same image: what is computed from it is kept for it
class RgbdFrame:
    """One RGB-D image with its camera.

    Attributes:
        time: Capture time in seconds.
        rgb: (H, W, 3) uint8 colour image.
        depth: (H, W) float32 depth along the optical axis in metres; 0 where it is missing.
        intrinsics: Intrinsics of colour and depth, which are registered.
        T_world_camera: (4, 4) camera pose; None if unknown.
    """

    time: float
    rgb: UInt8[np.ndarray, "_h _w 3"]
    depth: Float[np.ndarray, "_h _w"]
    intrinsics: CameraIntrinsics
    T_world_camera: Float[np.ndarray, "4 4"] | None = None

    def __post_init__(self) -> None:
        size = (self.intrinsics.height, self.intrinsics.width)
        _require(self.rgb.dtype == np.uint8, f"colour must be uint8, got {self.rgb.dtype}")
        _require(self.rgb.shape == (*size, 3), f"colour image is {self.rgb.shape}, camera says {(*size, 3)}")
        _require(self.depth.shape == size, f"depth image is {self.depth.shape}, camera says {size}")
        _require(self.depth.dtype.kind == "f", f"depth must be float metres, got {self.depth.dtype}")
        depth = np.asarray(self.depth, dtype=np.float32)
        _require(
            bool(np.isfinite(depth).all()), "depth has NaN or infinite pixels; mark missing depth with 0"
        )
        _require(bool((depth >= 0).all()), "depth has negative pixels; mark missing depth with 0")
        object.__setattr__(self, "rgb", _frozen(self.rgb))
        object.__setattr__(self, "depth", _frozen(depth))
        if self.T_world_camera is not None:
            object.__setattr__(self, "T_world_camera", check_rigid(self.T_world_camera, "T_world_camera"))


@dataclass(frozen=True)
class SupportPlane:
    """The plane that objects stand on, in the world frame: ``normal . p = offset``, normal pointing up."""

    normal: Float[np.ndarray, "3"] = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    offset: float = 0.0

    def height_above(self, points_world: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
        """Signed distance of points above the plane in [m]."""
        return points_world @ self.normal - self.offset


@dataclass(frozen=True)
class ObjectDetection:
    """One object in one image.

    Attributes:
        category: Most probable class.
        score: Confidence in the class, in 0..1.
        mask: (H, W) bool.
        class_probabilities: (5,) probabilities of CATEGORIES and 'other' (distractors); empty if unknown.
        yaw_probabilities: (B,) probabilities of B equal bins of the handle's direction in the world: bin k
            is centred at yaw 2 pi k / B about the support normal. Empty if unknown or for symmetric classes.
        instance_id: Identity of the object across images; None before association.
        support: Index of the support plane that the object stands on; 0 is the main one.
        pose_probabilities: (10,) probabilities of POSED_CLASSES and 'other', for objects in any resting pose;
            empty if unknown.
        axis_probabilities: (A,) the same bins of the direction of the axis from base to top, of what lies;
            empty if unknown.
    """

    category: Category
    score: float
    mask: Bool[np.ndarray, "h w"]
    class_probabilities: Float[np.ndarray, "k"] = field(default_factory=lambda: np.zeros(0))
    yaw_probabilities: Float[np.ndarray, "b"] = field(default_factory=lambda: np.zeros(0))
    instance_id: int | None = None
    support: int = 0
    pose_probabilities: Float[np.ndarray, "p"] = field(default_factory=lambda: np.zeros(0))
    axis_probabilities: Float[np.ndarray, "a"] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        _require(
            self.category in CATEGORIES, f"category '{self.category}' is none of {', '.join(CATEGORIES)}"
        )
        _require(self.mask.dtype == np.bool_ and self.mask.ndim == 2, "mask must be a 2-D bool image")
        _require(bool(self.mask.any()), f"the mask of a {self.category} is empty")
        object.__setattr__(self, "mask", _frozen(self.mask))


def unclassified(mask: Bool[np.ndarray, "h w"], instance_id: int | None = None) -> ObjectDetection:
    """Return the detection of a mask without a class: all class probabilities are equal."""
    equal = np.full(OTHER + 1, 1 / (OTHER + 1))
    return ObjectDetection(CATEGORIES[0], float(equal[0]), mask, equal, instance_id=instance_id)


def is_unclassified(detection: ObjectDetection) -> bool:
    """Return whether a detection was made by ``unclassified``: its category has no meaning."""
    return bool(detection.class_probabilities.size) and float(np.ptp(detection.class_probabilities)) == 0.0


@dataclass(frozen=True)
class TriangleMesh:
    """Vertices in [m] and triangles wound outwards."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", _frozen(self.vertices, np.float64))
        object.__setattr__(self, "faces", _frozen(self.faces, np.int64))

    def transformed(self, T_target_source: Float[np.ndarray, "4 4"]) -> TriangleMesh:
        """Return the mesh mapped by a rigid transform."""
        return TriangleMesh(self.vertices @ T_target_source[:3, :3].T + T_target_source[:3, 3], self.faces)


@dataclass(frozen=True)
class ObjectEstimate:
    """Estimate of a complete object: class, shape, pose and uncertainty.

    Attributes:
        id: Unique id in the object map.
        category: Class of the object.
        code: (16,) shape code of the class-conditional VAE.
        T_world_object: (4, 4) pose; object z up, mug handle along object +x.
        scale: (3,) metres per canonical unit along the object's axes.
        mesh: Watertight surface in the object frame, in metres (scale applied, pose not).
        score: Confidence in the class over all views, in 0..1.
        n_views: Number of images with a detection of the object.
        residual: Root mean square of the inlier depth residuals, in metres.
        status: Outcome of the fit.
        covariance: (25, 25) covariance of (code 16, rotation 3, translation 3, log scale 3), or None.
        surface_sigma: (v,) standard deviation of the mesh's vertices along their normals, in metres, or None.
        resting: Resting pose: axis up, axis horizontal, or axis down.
        rests_on: Id of the object that this one rests on; None for the support plane.
    """

    id: int
    category: Category
    code: Float[np.ndarray, "16"]
    T_world_object: Float[np.ndarray, "4 4"]
    scale: Float[np.ndarray, "3"]
    mesh: TriangleMesh
    score: float = 1.0
    n_views: int = 1
    residual: float = 0.0
    status: FitStatus = "converged"
    covariance: Float[np.ndarray, "25 25"] | None = None
    surface_sigma: Float[np.ndarray, "v"] | None = None
    resting: RestingPose = "upright"
    rests_on: int | None = None

    def __post_init__(self) -> None:
        _require(
            self.category in CATEGORIES, f"category '{self.category}' is none of {', '.join(CATEGORIES)}"
        )
        _require(self.resting in RESTING_POSES, f"resting '{self.resting}' is none of {RESTING_POSES}")
        object.__setattr__(self, "code", _frozen(self.code, np.float32))
        object.__setattr__(self, "scale", _frozen(self.scale, np.float64))
        object.__setattr__(self, "T_world_object", check_rigid(self.T_world_object, "T_world_object"))

    @property
    def name(self) -> str:
        return f"{self.category}_{self.id}"

    @property
    def mesh_world(self) -> TriangleMesh:
        return self.mesh.transformed(self.T_world_object)

    @property
    def height(self) -> float:
        """Extent along the object's z in [m]."""
        return float(np.ptp(self.mesh.vertices[:, 2]))

    @property
    def radius(self) -> float:
        """Half the extent along the object's y in [m]: the body's radius, the handle of a mug left out."""
        return float(np.ptp(self.mesh.vertices[:, 1]) / 2)

    @property
    def size(self) -> float:
        """Diagonal of the upright profile in [m]: the size by which objects are sorted.

        Bowls may be polygons, whose direction the estimate does not have: their largest width counts. The
        mesh of a narrow top ends in a tip, which does not count.
        """
        height = self._height_below_tip() if self.category == "bottle" else self.height
        return profile_size(height, self._widest() if self.category == "bowl" else self.radius)

    def _height_below_tip(self) -> float:
        """Return the height [m] above which faces that look up have a projected area of ``_TIP``."""
        corners = self.mesh.vertices[self.mesh.faces]
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
        middle = corners[area > 0, :, 2].mean(axis=1)
        highest = np.argsort(-middle)
        below = np.cumsum(area[area > 0][highest]) > _TIP
        if not below.any():
            return self.height
        return float(middle[highest][below][0] - self.mesh.vertices[:, 2].min())

    def _widest(self) -> float:
        """Return half the largest horizontal extent in any direction in [m]."""
        angles = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        across = self.mesh.vertices[:, :2] @ np.stack([np.cos(angles), np.sin(angles)])
        return float(np.ptp(across, axis=0).max() / 2)


@dataclass(frozen=True)
class RejectedObject:
    """A detected object that is not part of the object map.

    Attributes:
        id: Id of the object across the images.
        category: Class of its detections.
        reason: Why it was left out, in one line.
        score: Probability that it is an object of that class, in 0..1.
        is_part: Whether it is left out as a part of a thing of no class.
    """

    id: int
    category: Category
    reason: str
    score: float = 0.0
    is_part: bool = False

    @property
    def name(self) -> str:
        return f"{self.category}_{self.id}"


def profile_size(height: float, radius: float) -> float:
    """Return the diagonal of an upright profile of the given height and radius, in metres."""
    return float(np.hypot(height, 2 * radius))
