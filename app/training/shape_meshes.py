"""A user's meshes as training shapes: read from ShapeNet's layout, validated, voxelised.

    DIR/<synset>/<id>/models/model_normalized.obj     layout of ShapeNetCore: y up, any size
    DIR/<class>/*.{obj,ply,glb,stl}                   z up, any size

Non-watertight meshes, damaged files and unknown folders are skipped and reported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import UInt8

from perception.errors import InvalidInputError
from perception.inference.voxelise import voxelise
from perception.io.meshes import SUFFIXES
from perception.shape.dataset import ShapeDataset
from perception.types import CATEGORIES, GRID_RESOLUTION, Category, TriangleMesh
from sim_assets.errors import ObjectFileError
from sim_assets.objects.grids import canonical_frame
from sim_assets.objects.user import load_user_mesh

SYNSETS: dict[str, Category] = {
    "03797390": "mug",
    "02880940": "bowl",
    "02876657": "bottle",
    "02946921": "can",
}
SHAPENET_FILE = Path("models") / "model_normalized.obj"
HELD_OUT = 0.1  # share of each class; at least one mesh of two or more

_LENGTH = 0.1  # [m] to which meshes are scaled: the limits of the reader are metric
_LAYOUT = "expected DIR/<synset>/<id>/models/model_normalized.obj or DIR/<class>/*.obj"


@dataclass(frozen=True)
class MeshFile:
    """A mesh file.

    Attributes:
        path: File.
        category: Class.
        y_up: Whether y is up; otherwise z.
    """

    path: Path
    category: Category
    y_up: bool


@dataclass(frozen=True)
class MeshShapes:
    """Shapes of a folder of meshes.

    Attributes:
        train: Training shapes.
        test: Held-out shapes.
        skipped: For each skipped file or folder a line with the reason.
    """

    train: ShapeDataset
    test: ShapeDataset
    skipped: tuple[str, ...]


def load_shapes(
    folder: Path, seed: int, progress: Callable[[int, int], None] = lambda done, total: None
) -> MeshShapes:
    """Return the valid meshes of a folder as grids; ``seed`` selects the tenth of each class held out.

    Raises:
        InvalidInputError: The folder does not exist, or has no valid mesh.
    """
    files, skipped = find_meshes(folder)
    if not files:
        raise InvalidInputError(f"{folder} holds no meshes: {_LAYOUT}")
    grids: dict[Category, list[np.ndarray]] = {category: [] for category in CATEGORIES}
    for done, file in enumerate(files, start=1):
        try:
            grids[file.category].append(mesh_grid(file))
        except ObjectFileError as error:
            skipped.append(str(error))
        progress(done, len(files))
    train, test = _split(grids, np.random.default_rng(seed))
    if not len(train):
        raise InvalidInputError(
            f"none of the {len(files)} meshes in {folder} can be used; the first: {skipped[0]}"
        )
    return MeshShapes(train, test, tuple(skipped))


def find_meshes(folder: Path) -> tuple[list[MeshFile], list[str]]:
    """Return the mesh files of a folder in order, and a line for each unknown subfolder.

    Raises:
        InvalidInputError: The folder does not exist.
    """
    if not folder.is_dir():
        raise InvalidInputError(f"{folder} is no folder: {_LAYOUT}")
    files, skipped = [], []
    for place in sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != "."):
        category: Category | None = SYNSETS.get(place.name)
        category = category or next((c for c in CATEGORIES if c == place.name), None)
        if category is None:
            skipped.append(f"{place}: neither a class ({', '.join(CATEGORIES)}) nor one of their synsets")
            continue
        shapenet = sorted(path for path in place.glob(f"*/{SHAPENET_FILE}") if path.is_file())
        loose = sorted(path for path in place.iterdir() if path.suffix.lower() in SUFFIXES)
        for path in (*shapenet, *loose):
            files.append(MeshFile(path, category, y_up=path.name == SHAPENET_FILE.name))
    return files, skipped


def mesh_grid(file: MeshFile) -> UInt8[np.ndarray, "32 32 32"]:
    """Return the occupancy grid times 255 in the conventions of ``sim_assets/objects/grids.py``.

    The bounding box is centred, its longest side is 1.8; z is up, the handle of a mug along +x.

    Raises:
        ObjectFileError: The file is damaged, or the mesh is not watertight.
    """
    mesh = load_user_mesh(file.path, file.category, y_up=file.y_up, length=_LENGTH)
    scale, centre = canonical_frame(np.asarray(mesh.bounds))
    mesh = trimesh.Trimesh(mesh.vertices - centre, mesh.faces, process=False)
    grid = voxelise(TriangleMesh(mesh.vertices, mesh.faces), np.full(3, scale), supersample=4)
    return np.rint(255 * grid).astype(np.uint8)


def _split(
    grids: dict[Category, list[np.ndarray]], rng: np.random.Generator
) -> tuple[ShapeDataset, ShapeDataset]:
    train: dict[Category, np.ndarray] = {}
    test: dict[Category, np.ndarray] = {}
    for category, found in grids.items():
        stacked = np.array(found, np.uint8).reshape(-1, *(GRID_RESOLUTION,) * 3)
        order = rng.permutation(len(stacked))
        held = max(round(HELD_OUT * len(order)), 1) if len(order) > 1 else 0
        test[category], train[category] = stacked[order[:held]], stacked[order[held:]]
    return ShapeDataset.from_grids(train), ShapeDataset.from_grids(test)
