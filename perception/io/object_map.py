"""The object map on disk: ``objects.json`` and one watertight mesh in the world frame for each object.

objects.json                 id, category, T_world_object, scale, code, height, radius, score, ... [m]
objects/<id>_<category>.ply  the mesh in the world frame [m]
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from perception.errors import InvalidInputError
from perception.io.files import read_json, write_atomically, write_json
from perception.io.meshes import read_mesh
from perception.io.scan_cameras import read_numbers
from perception.types import (
    CODE_SIZE,
    FIT_STATUSES,
    RESTING_POSES,
    ObjectEstimate,
    RejectedObject,
    TriangleMesh,
    check_rigid,
)

logger = logging.getLogger(__name__)
Word = TypeVar("Word", bound=str)
PLANE = "plane"  # what an object rests on that rests on no other object
SIZE_TOLERANCE = 0.05  # of height and radius relative to those of the mesh
MIN_SCALE, MAX_SCALE = 1e-3, 10.0  # [m] of the half side of an object's grid
MAX_DISTANCE = 200.0  # [m] of anything in a map, whose cameras are within 100 m
MAX_OVERHANG = 3.0  # canonical units from the origin to any vertex; shapes are in [-1, 1]^3
_MESH_NAME = re.compile(r"\d+_[a-z]+\.ply")


def write_object_map(folder: str | Path, objects: Sequence[ObjectEstimate]) -> list[RejectedObject]:
    """Write the meshes and then ``objects.json``; meshes of a previous object map are removed.

    Returns:
        The objects that are left out because they have an empty mesh or a number that is not finite.

    Raises:
        OSError: A file cannot be written.
    """
    folder = Path(folder)
    entries, rejected = {}, []
    kept = {estimate.id for estimate in objects if _is_finite(estimate)}
    for estimate in objects:
        if not _is_finite(estimate):
            reason = "its mesh is empty or has numbers that are not finite"
            rejected.append(RejectedObject(estimate.id, estimate.category, reason))
            logger.warning("%s is left out of the object map: %s", estimate.name, reason)
            continue
        write_atomically(folder / "objects" / _mesh_name(estimate), ply_bytes(estimate.mesh_world))
        below = estimate.rests_on if estimate.rests_on in kept else None
        entries[_mesh_name(estimate)] = _entry(replace(estimate, rests_on=below))
    write_json(folder / "objects.json", list(entries.values()))
    for path in (folder / "objects").glob("*.ply"):
        if _MESH_NAME.fullmatch(path.name) and path.name not in entries:
            path.unlink()
    return rejected


def read_object_map(folder: str | Path) -> list[ObjectEstimate]:
    """Read an object map written by ``write_object_map``.

    Raises:
        InvalidInputError: A file is missing or malformed; the message names it.
    """
    folder = Path(folder)
    path = folder / "objects.json"
    entries = read_json(path, "give the folder that `reconstruct`, `pack` or `sort` wrote")
    if not isinstance(entries, list):
        raise InvalidInputError(f"{path} must be a list of objects: reconstruct the scan again")
    objects = []
    for index, entry in enumerate(entries):
        try:
            objects.append(_estimate(folder, entry, {estimate.id for estimate in objects}))
        except (InvalidInputError, KeyError, TypeError, ValueError, OverflowError) as error:
            problem = f"{error} is missing" if isinstance(error, KeyError) else error
            message = f"{path}, object {index}: {problem}: reconstruct the scan again"
            raise InvalidInputError(message) from None
    _check_stacks(objects, path)
    return objects


def ply_bytes(mesh: TriangleMesh) -> bytes:
    """Encode a mesh as a binary little-endian PLY file."""
    vertices = np.asarray(mesh.vertices, dtype="<f4")
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, mesh.faces
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode() + vertices.tobytes() + faces.tobytes()


def read_ply(path: Path) -> TriangleMesh:
    """Read a triangle mesh from a PLY file.

    Raises:
        InvalidInputError: The file is missing, not regular, too large, damaged, or without triangles.
    """
    mesh = read_mesh(path)
    return TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def _mesh_name(estimate: ObjectEstimate) -> str:
    return f"{estimate.id}_{estimate.category}.ply"


def _entry(estimate: ObjectEstimate) -> dict[str, Any]:
    return {
        "id": estimate.id,
        "category": estimate.category,
        "T_world_object": estimate.T_world_object.tolist(),
        "scale": estimate.scale.tolist(),
        "code": [float(c) for c in estimate.code],
        "height": estimate.height,
        "radius": estimate.radius,
        "score": float(estimate.score),
        "n_views": int(estimate.n_views),
        "residual": float(estimate.residual),
        "status": estimate.status,
        "resting": estimate.resting,
        "rests_on": PLANE if estimate.rests_on is None else estimate.rests_on,
    }


def _is_finite(estimate: ObjectEstimate) -> bool:
    """Return whether the mesh has faces and all numbers of an estimate are finite, as JSON requires."""
    if not len(estimate.mesh.faces):
        return False
    numbers = (estimate.mesh.vertices, estimate.T_world_object, estimate.scale, estimate.code)
    return all(np.isfinite(value).all() for value in (*numbers, estimate.score, estimate.residual))


def _estimate(folder: Path, entry: Any, used: Set[int]) -> ObjectEstimate:
    """Read an object whose id is not used yet."""
    if not isinstance(entry, dict):
        raise InvalidInputError("it is no JSON object")
    if type(entry["id"]) is not int or entry["id"] < 0 or not isinstance(entry["category"], str):
        raise InvalidInputError(f"id {entry['id']!r}, category {entry['category']!r} are no number and name")
    if entry["id"] in used:
        raise InvalidInputError(f"another object has the id {entry['id']}, too")
    code, scale = read_numbers(entry, "code", CODE_SIZE), read_numbers(entry, "scale", 3)
    score, n_views, residual = (
        float(read_numbers(entry, key, 1)[0]) for key in ("score", "n_views", "residual")
    )
    if not (scale >= MIN_SCALE).all() or not (scale <= MAX_SCALE).all():
        raise InvalidInputError(f"scale must be {MIN_SCALE:g} to {MAX_SCALE:g} m")
    if residual < 0 or not 0 <= score <= 1:
        raise InvalidInputError("residual must not be negative, score in 0..1")
    if n_views < 0 or n_views != int(n_views):
        raise InvalidInputError(f"n_views {n_views:g} is no number of images")
    name = f"{entry['id']}_{entry['category']}.ply"
    if not _MESH_NAME.fullmatch(name):
        raise InvalidInputError(f"category {entry['category']!r} is no class name")
    T_world_object = read_numbers(entry, "T_world_object", 16).reshape(4, 4)
    check_rigid(T_world_object, "T_world_object")
    mesh_world = read_ply(folder / "objects" / name)
    if not max(np.abs(mesh_world.vertices).max(), np.abs(T_world_object).max()) <= MAX_DISTANCE:
        raise InvalidInputError(f"its pose and mesh must be within {MAX_DISTANCE:g} m")
    estimate = ObjectEstimate(
        id=entry["id"],
        category=entry["category"],  # pyright: ignore[reportArgumentType]  # checked by ObjectEstimate
        code=code,
        T_world_object=T_world_object,
        scale=scale,
        mesh=mesh_world.transformed(np.linalg.inv(T_world_object)),
        score=score,
        n_views=int(n_views),
        residual=residual,
        status=_one_of(entry, "status", FIT_STATUSES),
        resting=_one_of(entry, "resting", RESTING_POSES),
        rests_on=_rests_on(entry.get("rests_on", PLANE)),
    )
    if not (np.abs(estimate.mesh.vertices) <= MAX_OVERHANG * scale.max()).all():
        raise InvalidInputError(f"{name} is far from its pose")
    for key, measured in (("height", estimate.height), ("radius", estimate.radius)):
        stated = float(read_numbers(entry, key, 1)[0])
        if abs(stated - measured) > SIZE_TOLERANCE * max(measured, 0.01):
            raise InvalidInputError(f"{key} {stated:g} m is not that of {name}, {measured:.4g} m")
    return estimate


def _one_of(entry: dict[str, Any], key: str, words: tuple[Word, ...]) -> Word:
    """Return a word of a list, the first one by default."""
    value = entry.get(key, words[0])
    found = next((word for word in words if word == value), None)
    if found is None:
        raise InvalidInputError(f"{key} {str(value)[:80]!r} is none of {', '.join(words)}")
    return found


def _check_stacks(objects: Sequence[ObjectEstimate], path: Path) -> None:
    """Raise InvalidInputError unless each object rests, in the end, on the plane."""
    below = {estimate.id: estimate.rests_on for estimate in objects}
    for estimate in objects:
        seen, at = {estimate.id}, estimate.rests_on
        while at is not None:
            if at not in below:
                raise InvalidInputError(
                    f"{path}: {estimate.name} rests on object {at}, which is not in the map"
                )
            if at in seen:
                raise InvalidInputError(f"{path}: {estimate.name} rests on itself, over object {at}")
            seen.add(at)
            at = below[at]


def _rests_on(value: Any) -> int | None:
    """Return the id of the object below, None for the plane."""
    if value == PLANE:
        return None
    if isinstance(value, bool) or not isinstance(value, int):
        raise InvalidInputError(f"rests_on {value!r} is neither '{PLANE}' nor the id of an object")
    return value
