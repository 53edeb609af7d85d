"""Convex pieces of arbitrary meshes, cut first for fast decomposition and open cavities.

A hollow vessel is cut into wedges around its axis and levels of height, a closed one into slices: most
parts are replaced by their hulls; coacd decomposes the others. The lowest 2 mm of a vessel become one piece,
so that only the base touches the table. Results are cached by the content of the mesh.
"""

from __future__ import annotations

import hashlib
import io
import logging
import os
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float

from perception.io.arrays import read_arrays
from perception.io.files import write_atomically
from perception.types import Category

logger = logging.getLogger(__name__)

VERSION = "6"  # version of the algorithm, part of the cache key
WEDGES = {"mug": 16, "bowl": 20}
LEVELS = (0.0, 0.12, 0.3, 0.6, 1.0)  # of a vessel, over the height above its base
SLICES = 12  # of a closed body
BASE = 0.002  # [m]
EXCESS = 1.2e-3  # largest mean thickness that a hull may add to a part [m]
HULL_VERTICES = 32
MOST_HULLS = 3  # largest number of hulls of one part


def cache_folder() -> Path:
    """Return the folder of cached decompositions: $XDG_CACHE_HOME/nodeslam, else ~/.cache/nodeslam.

    Without a home folder, as for unknown users in containers, it is a folder of the user's temporary files.
    """
    root = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    if not root.is_absolute():
        root = Path(tempfile.gettempdir()) / f"nodeslam-cache-{os.getuid()}"
    return root / "nodeslam"


def cad_pieces(mesh: trimesh.Trimesh, category: Category, name: str) -> list[Float[np.ndarray, "n 3"]]:
    """Return the corners of the convex pieces of a watertight mesh in its object frame, cached."""
    content = (
        np.ascontiguousarray(mesh.vertices, "<f8").tobytes()
        + np.ascontiguousarray(mesh.faces, "<i8").tobytes()
    )
    key = hashlib.sha256(f"{VERSION} {category}".encode() + content).hexdigest()[:32]
    path = cache_folder() / f"convex_{key}.npz"
    if path.exists():
        try:
            stored = read_arrays(path)
            return np.split(stored["vertices"], np.cumsum(stored["counts"])[:-1])
        except (OSError, ValueError, KeyError) as error:
            logger.warning("The cached decomposition %s is unreadable (%s); computing it again", path, error)
    logger.info("Decomposing %s into convex pieces, once; this takes up to a minute", name)
    start = time.perf_counter()
    pieces = _decompose(mesh, category)
    logger.info("%s: %d convex pieces in %.0f s", name, len(pieces), time.perf_counter() - start)
    _store(path, pieces)
    return pieces


def _store(path: Path, pieces: list[np.ndarray]) -> None:
    """Write the cache atomically; a failure is logged and otherwise ignored."""
    content = io.BytesIO()
    np.savez_compressed(content, vertices=np.concatenate(pieces), counts=[len(piece) for piece in pieces])
    try:
        write_atomically(path, content.getvalue())
    except OSError as error:
        logger.warning("Could not cache the decomposition in %s: %s", path, error)


def _decompose(mesh: trimesh.Trimesh, category: Category) -> list[np.ndarray]:
    if category not in WEDGES:
        if _nearly_convex(mesh, EXCESS):
            return [np.asarray(mesh.convex_hull.vertices)]
        slices = (_part(mesh, cutter) for cutter in _slices(mesh.bounds))
        return [piece for part in slices for piece in _pieces_of(part, excess=5 * EXCESS)]
    height = float(mesh.bounds[1, 2])
    base = _part(mesh, _slab(mesh.bounds, -0.01, BASE))
    pieces = [np.asarray(base.convex_hull.vertices)]
    edges = BASE + (height - BASE) * np.array(LEVELS)
    for low, high in pairwise(edges):
        level = _part(mesh, _slab(mesh.bounds, low, high))
        for wedge in _wedges(level.bounds, WEDGES[category]):
            for lump in _part(level, wedge).split(only_watertight=True):
                if lump.volume > 1e-9:
                    pieces += _pieces_of(lump, EXCESS)
    return pieces


def _nearly_convex(mesh: trimesh.Trimesh, excess: float) -> bool:
    """Return whether the hull adds less than `excess` [m] to the thickness, on average over the part."""
    return bool(mesh.convex_hull.volume - mesh.volume < excess * 0.5 * mesh.area)


def _part(mesh: trimesh.Trimesh, cutter: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.boolean.intersection([mesh, cutter], engine="manifold")


def _slab(bounds: np.ndarray, low: float, high: float) -> trimesh.Trimesh:
    """Return a horizontal slab wider than the object."""
    reach = 2.0 * float(np.abs(bounds).max())
    return trimesh.creation.box(bounds=[(-reach, -reach, low), (reach, reach, high)])


def _slices(bounds: np.ndarray) -> list[trimesh.Trimesh]:
    edges = np.linspace(bounds[0, 2], bounds[1, 2], SLICES + 1)
    return [_slab(bounds, low, high) for low, high in pairwise(edges)]


def _wedges(bounds: np.ndarray, count: int) -> list[trimesh.Trimesh]:
    """Return wedges around the axis, the first centred on +x, the side of a mug's handle."""
    reach = 2.0 * float(np.abs(bounds).max())
    wedges = []
    for k in range(count):
        angles = 2 * np.pi * (k + np.array([-0.5, 0.5])) / count
        triangle = np.concatenate([[(0.0, 0.0)], reach * np.stack([np.cos(angles), np.sin(angles)], axis=1)])
        corners = [(x, y, z) for x, y in triangle for z in bounds[:, 2] + (-0.01, 0.01)]
        wedges.append(trimesh.convex.convex_hull(np.array(corners)))
    return wedges


def _pieces_of(lump: trimesh.Trimesh, excess: float) -> list[np.ndarray]:
    """Return the hull if it adds little volume, else coacd's pieces."""
    if _nearly_convex(lump, excess):
        return [np.asarray(lump.convex_hull.vertices)]
    import coacd  # slow to import; used for users' meshes only

    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(lump.vertices, lump.faces),
        threshold=0.1,
        max_convex_hull=MOST_HULLS,
        preprocess_mode="off",  # the parts are manifold already
        mcts_nodes=10,
        mcts_iterations=20,
        mcts_max_depth=2,
        resolution=300,
        decimate=True,
        max_ch_vertex=HULL_VERTICES,
        seed=0,
    )
    return [np.asarray(vertices) for vertices, _ in parts]
