"""Object models from users' meshes: ``DIR/<class>/*.{ply,obj,glb,stl}``, in metres, z up.

A mesh is moved so that its base lies on z = 0 and its axis on x = y = 0: the middle of its bounding box, for
mugs the centre of the circle that their upper part lies on. A mug is turned so that its farthest point, the
handle, lies along +x. An axis right within 2 mm, or a handle within 0.2 rad, stays as it is.
"""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import trimesh
from scipy.optimize import least_squares

from perception.errors import InvalidInputError
from perception.io.meshes import SUFFIXES, read_mesh
from perception.types import Category
from sim_assets.errors import ObjectFileError
from sim_assets.objects.convex.cad_mesh import cad_pieces
from sim_assets.objects.convex.pieces import hull
from sim_assets.objects.mesh_shape import MeshShape
from sim_assets.objects.model import HEAVIEST, LIGHTEST, ObjectModel

SMALLEST, LARGEST = 0.02, 0.5  # range of the longest side [m]
DENSITIES = {"mug": 2300.0, "bowl": 2000.0, "bottle": 500.0, "can": 700.0}  # [kg/m³], contents included
SNUG = 0.002  # [m]


def load_user_objects(directory: Path | str) -> list[ObjectModel]:
    """Load every mesh under a folder, by class and file name.

    Raises:
        ObjectFileError: the folder is missing, has an unknown class or no meshes, or a mesh is unusable.
    """
    return [load_user_object(path, category) for path, category in mesh_files(directory)]


def mesh_files(directory: Path | str) -> list[tuple[Path, Category]]:
    """List the mesh files under a folder with their classes, by class and file name.

    Raises:
        ObjectFileError: the folder is missing, or has an unknown class or no meshes.
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise ObjectFileError(f"{directory} is not a folder; expected DIR/<class>/*.{{ply,obj,glb,stl}}")
    classes: tuple[Category, ...] = get_args(Category)
    files = []
    for folder in sorted(path for path in directory.iterdir() if path.is_dir() and path.name[0] != "."):
        category = next((c for c in classes if c == folder.name), None)
        if category is None:
            raise ObjectFileError(f"{folder}: '{folder.name}' is none of the classes {', '.join(classes)}")
        meshes = (path for path in sorted(folder.iterdir()) if path.suffix.lower() in SUFFIXES)
        files += [(path, category) for path in meshes]
    if not files:
        raise ObjectFileError(
            f"{directory} holds no meshes; expected {directory}/<class>/*.{{ply,obj,glb,stl}} "
            f"with a class of {', '.join(classes)}"
        )
    return files


def load_user_object(path: Path | str, category: Category, collision: bool = True) -> ObjectModel:
    """Load a mesh file as an object; simulation needs its collision pieces, which are slow to compute.

    Raises:
        ObjectFileError: the file is unreadable, empty, not watertight, or of an implausible size.
    """
    path = Path(path)
    mesh = load_user_mesh(path, category)
    pieces = tuple(map(hull, cad_pieces(mesh, category, path.name))) if collision else ()
    mass = float(np.clip(mesh.volume * DENSITIES[category], LIGHTEST, HEAVIEST))
    return ObjectModel(category, "user", path.stem, mesh, pieces, mass, None, MeshShape(mesh, category))


def load_user_mesh(
    path: Path, category: Category, y_up: bool = False, length: float | None = None
) -> trimesh.Trimesh:
    """Return the mesh of a file, checked and moved into the object frame.

    Args:
        path: path of the mesh file.
        category: class of the object.
        y_up: whether the file's y axis points up, as in ShapeNet, instead of z.
        length: length that the longest side is scaled to [m]; not scaled by default.

    Raises:
        ObjectFileError: the file is unreadable, empty, not watertight, or of an implausible size.
    """
    return _in_object_frame(_read(path, y_up, length), category)


def _read(path: Path, y_up: bool, length: float | None) -> trimesh.Trimesh:
    """Return the file's mesh in its own frame, checked."""
    try:
        mesh = read_mesh(path)
    except InvalidInputError as error:
        raise ObjectFileError(str(error)) from error
    if y_up:
        mesh.vertices = mesh.vertices[:, (0, 2, 1)] * (1, -1, 1)
    if length is not None and mesh.extents.max() > 0:
        mesh.vertices *= length / mesh.extents.max()
    _check_size(path, float(mesh.extents.max()))
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)  # geometry alone, vertices merged
    mesh.update_faces((mesh.faces != np.roll(mesh.faces, 1, axis=1)).all(axis=1))  # now lines, not triangles
    if not mesh.is_watertight:
        mesh.fill_holes()
    if not mesh.is_watertight:
        sides = np.bincount(mesh.edges_unique_inverse)
        raise ObjectFileError(
            f"{path} is not watertight ({int((sides != 2).sum())} edges without exactly two triangles); "
            "close its holes in a mesh editor"
        )
    if not mesh.is_winding_consistent or mesh.volume < 0:
        mesh.fix_normals()
    if mesh.volume < 1e-7:
        raise ObjectFileError(f"{path} encloses no volume; give its surface a thickness")
    return mesh


def _check_size(path: Path, longest: float) -> None:
    if SMALLEST <= longest <= LARGEST:
        return
    for unit, metres in (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254)):
        if longest > LARGEST and SMALLEST <= longest * metres <= LARGEST:
            raise ObjectFileError(
                f"{path} is {longest:.4g} m long: looks like {unit}; scale it by {metres:g} to metres"
            )
    raise ObjectFileError(
        f"{path} is {longest:.4g} m long; objects of {SMALLEST:g} to {LARGEST:g} m are possible, in metres"
    )


def _in_object_frame(mesh: trimesh.Trimesh, category: Category) -> trimesh.Trimesh:
    """Return a copy of the mesh aligned with the object frame: base, axis and handle."""
    vertices = np.array(mesh.vertices)
    vertices[:, 2] -= vertices[:, 2].min()
    centre = 0.5 * (vertices[:, :2].min(axis=0) + vertices[:, :2].max(axis=0))
    if category == "mug":
        centre = _circle_centre(mesh, centre)
    if np.abs(centre).max() > SNUG:
        vertices[:, :2] -= centre
    if category == "mug":
        farthest = vertices[np.hypot(vertices[:, 0], vertices[:, 1]).argmax()]
        if abs(np.arctan2(farthest[1], farthest[0])) > 0.2:  # angular width of a handle
            direction = farthest[:2] / np.hypot(*farthest[:2])
            rotation = np.array([direction, (-direction[1], direction[0])])
            vertices[:, :2] = vertices[:, :2] @ rotation.T
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def _circle_centre(mesh: trimesh.Trimesh, start: np.ndarray) -> np.ndarray:
    """Fit a circle to the upper part of a mug and return its centre; the handle is an outlier."""
    points = trimesh.sample.sample_surface(mesh, 20_000, seed=0)[0]
    low, high = mesh.bounds[:, 2]
    rim = points[points[:, 2] > low + 0.85 * (high - low), :2]

    def residual(circle: np.ndarray) -> np.ndarray:
        return np.hypot(*(rim - circle[:2]).T) - circle[2]

    guess = np.array([*start, np.median(np.hypot(*(rim - start).T))])
    return least_squares(residual, guess, loss="soft_l1", f_scale=1e-3).x[:2]
