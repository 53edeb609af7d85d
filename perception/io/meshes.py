"""Mesh files (PLY, OBJ, STL, GLB): bounded reading, by trimesh, of geometry from unknown sources.

A file of a hundred bytes can announce billions of elements, so that its announcements are compared with its
size before it is parsed. Nothing outside the file is read: materials, textures and buffers in other files are
ignored or refused.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InvalidInputError
from perception.io.files import parse_json, read_bytes

SUFFIXES = (".ply", ".obj", ".glb", ".stl")
MAX_MESH_BYTES = 512 * 2**20
MAX_TRIANGLES = 600_000  # more take minutes to cut into convex pieces
MAX_NODES = 100_000  # of a GLB file
_MAX_HEADER = 65_536  # bytes of a PLY header
_GLTF_ITEM_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}  # by componentType
_GLTF_ITEMS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_JSON_CHUNK = 0x4E4F534A


def read_mesh(path: Path) -> Any:
    """Return all triangles of a mesh file as one ``trimesh.Trimesh``, without materials.

    Raises:
        InvalidInputError: The file is missing, not regular, too large or damaged, or its vertices are not
            finite; the message names it and the remedy.
    """
    mesh = _loaded(path, force="mesh", skip_materials=True)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    # trimesh reads some damaged files as empty meshes, without an error
    if faces.ndim != 2 or not len(faces):
        raise InvalidInputError(f"{path} holds no triangles; the file is empty or damaged, export it again")
    if not np.isfinite(vertices).all():
        raise InvalidInputError(f"{path} has vertices that are not finite; export it again")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InvalidInputError(f"{path} has triangles of missing vertices; export it again")
    if len(faces) > MAX_TRIANGLES:
        raise InvalidInputError(
            f"{path} has {len(faces)} triangles, at most {MAX_TRIANGLES} are read; simplify it"
        )
    return mesh


def read_mesh_scene(path: Path) -> Any:
    """Return the content of a mesh file as a ``trimesh.Scene``, with materials.

    Raises:
        InvalidInputError: As ``read_mesh``, except that vertices are not checked.
    """
    return _loaded(path, force="scene")


def _loaded(path: Path, **options: Any) -> Any:
    import trimesh  # slow to import

    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise InvalidInputError(f"{path} is none of {', '.join(SUFFIXES)}; convert it")
    try:
        content = read_bytes(path, MAX_MESH_BYTES)
        if kind == ".ply":
            _check_ply(content)
        elif kind == ".glb":
            _check_glb(content)
        with np.errstate(all="ignore"):  # numbers that overflow are refused by the callers
            return trimesh.load(io.BytesIO(content), file_type=kind[1:], process=False, **options)
    except InvalidInputError:
        raise
    except FileNotFoundError:
        raise InvalidInputError(f"{path} is missing") from None
    except Exception as error:  # readers raise exceptions of any type
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InvalidInputError(f"{path} cannot be read as a mesh ({reason}); export it again") from error


def _check_ply(content: bytes) -> None:
    """Raise ValueError if the header announces more elements than the file can hold."""
    header, end, _ = content[:_MAX_HEADER].partition(b"end_header")
    if not header.startswith(b"ply") or not end:
        raise ValueError("it has no PLY header")
    for line in header.splitlines():
        words = line.split()
        if len(words) >= 3 and words[0] == b"element":
            digits = words[2].lstrip(b"0")
            if len(digits) > 12 or int(digits or b"0") > len(content):
                name = words[1][:20].decode("ascii", "replace")
                raise ValueError(f"it announces more elements '{name}' than it has bytes")


def _check_glb(content: bytes) -> None:
    """Raise ValueError if the file refers to others, announces too much, or its nodes are no tree."""
    if len(content) < 20 or content[:4] != b"glTF":
        raise ValueError("it has no GLB header")
    length, kind = struct.unpack("<II", content[12:20])
    if kind != _JSON_CHUNK or length > len(content) - 20:
        raise ValueError("its JSON chunk is missing or truncated")
    tree = parse_json(content[20 : 20 + length])
    if not isinstance(tree, dict):
        raise ValueError("its JSON chunk is no object")
    compressed = [name for name in _strings(tree.get("extensionsRequired")) if "compression" in name]
    if compressed:
        raise ValueError(f"it needs {compressed[0]}: export it without compression")
    for entry in (*_entries(tree, "buffers"), *_entries(tree, "images")):
        if not str(entry.get("uri", "data:")).startswith("data:"):
            raise ValueError("it refers to another file: embed all data")
    sizes = [_accessor_bytes(entry) for entry in _entries(tree, "accessors")]
    if max(sizes, default=0) > len(content):
        raise ValueError("it announces more data than it holds")
    _check_nodes(tree)


def _accessor_bytes(accessor: Mapping[str, Any]) -> int:
    count = accessor.get("count")
    if not isinstance(count, int) or count < 0:
        raise ValueError("an accessor has no count")
    items = _GLTF_ITEMS.get(str(accessor.get("type")), 1)
    return count * items * _GLTF_ITEM_BYTES.get(accessor.get("componentType", 0), 1)


def _check_nodes(tree: Mapping[str, Any]) -> None:
    """Raise ValueError unless every node has at most one parent, and the nodes' meshes are not too large."""
    nodes = _entries(tree, "nodes")
    children = [child for node in nodes for child in _integers(node.get("children"))]
    roots = [root for scene in _entries(tree, "scenes") for root in _integers(scene.get("nodes"))]
    if len(nodes) > MAX_NODES or len(children) != len(set(children)) or set(roots) & set(children):
        raise ValueError("its nodes are no tree")
    accessors, meshes = _entries(tree, "accessors"), _entries(tree, "meshes")
    vertices = [sum(_vertex_counts(mesh, accessors)) for mesh in meshes]
    used = [index for node in nodes for index in _integers([node.get("mesh")])]
    if sum(vertices[index] for index in used if 0 <= index < len(meshes)) > 3 * MAX_TRIANGLES:
        raise ValueError(f"its nodes have more than {3 * MAX_TRIANGLES} vertices")


def _vertex_counts(mesh: Mapping[str, Any], accessors: list[Mapping[str, Any]]) -> Iterable[int]:
    """Yield for each primitive the larger one of its numbers of vertices and of indices."""
    for primitive in _entries(mesh, "primitives"):
        attributes = primitive.get("attributes")
        position = attributes.get("POSITION") if isinstance(attributes, dict) else None
        used = _integers([position, primitive.get("indices")])
        yield max((accessors[index]["count"] for index in used if 0 <= index < len(accessors)), default=0)


def _entries(tree: Mapping[str, Any], key: str) -> list[Mapping[str, Any]]:
    """Return a list of JSON objects; empty if the key is missing."""
    values = tree.get(key, [])
    if not isinstance(values, list) or not all(isinstance(value, dict) for value in values):
        raise ValueError(f"its {key} are no list of objects")
    return values


def _integers(values: Any) -> list[int]:
    return [value for value in values if type(value) is int] if isinstance(values, list) else []


def _strings(values: Any) -> list[str]:
    return [value for value in values if isinstance(value, str)] if isinstance(values, list) else []
