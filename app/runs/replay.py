"""Recording of a run: motion, intermediate results and their times. Viewers play it, also while it grows.

    replay.npz    show_time, time, joint_positions, gripper_width, body_poses; and the events as text
    replay.json   names of the moving bodies; notes: [time, kind, {...}]
    replay.glb    visual meshes of the bodies: nodes <body>/<part>, each in its body's frame

*Show time* orders all samples and notes. It advances with simulated time, and by a fixed duration for each
note: a recording plays the same whatever the speed of the machine that made it.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import trimesh
from jaxtyping import Float

from app.runs.note_schema import MAX_LENGTH, check_note, is_finite_number
from perception.errors import InvalidInputError
from perception.io.arrays import read_arrays
from perception.io.files import read_json, write_atomically
from perception.io.meshes import read_mesh_scene
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame

NoteKind = Literal["stage", "done", "look", "found", "fit", "objects", "obstacles", "plan", "action", "path"]
# Show time that a note takes, in seconds.
BEAT: dict[NoteKind, float] = {
    "stage": 0.6,
    "look": 0.3,
    "found": 0.35,
    "fit": 0.12,
    "objects": 0.8,
    "plan": 1.5,
}
MAX_TIME = 4 * 3600.0  # [s] of a recording that is read: pages hold a snapshot for every tenth of a second
Bodies = Mapping[str, tuple[trimesh.Trimesh, ...]]


@dataclass(frozen=True)
class Note:
    """An event at a show time in seconds, with plain values as data:

    stage   name                                     a stage begins
    done    name, seconds                            a stage ends, after so many seconds of wall time
    look    index                                    an image was captured
    found   index, count                             objects were detected in an image
    fit     id, category, code, T_world_object, scale, residual [m], iteration
    objects covariances: {id: upper triangle}        the object map is complete
    obstacles pieces: {name: [vertices [m] of each convex piece]}
    plan    placements: [{name, T_world_stand, position, yaws, stack}], left_out
    action  phase, name, message, done, total; at "approach" T_stand_tcp, T_world_stand_rest, grasps
    path    name, points [m]                         path of the tool in the next motions
    """

    time: float
    kind: NoteKind
    data: Mapping[str, Any]


@dataclass
class Recorder:
    """Collects a run. Its lists only grow, so that a viewer can read them from another thread at any time.

    Attributes:
        bodies: Names of the moving bodies, in the order of ``poses``.
        meshes: Visual meshes of the bodies.
        now: Current show time in seconds.
        show_times, times: Show time and simulated time of the samples, in seconds.
        joints, widths: Arm joints [rad] and gripper width [m] of the samples.
        poses: Positions [m] and quaternions wxyz of the bodies.
        notes: Events in order of time.
        frames, detections, objects: Images and results, which are stored in files of their own.
    """

    bodies: tuple[str, ...] = ()
    meshes: Bodies = field(default_factory=dict)
    now: float = 0.0
    show_times: list[float] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    joints: list[Float[np.ndarray, "_j"]] = field(default_factory=list)
    widths: list[float] = field(default_factory=list)
    poses: list[Float[np.ndarray, "_b 7"]] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    frames: list[RgbdFrame] = field(default_factory=list)
    detections: Sequence[Sequence[ObjectDetection]] = ()
    objects: Sequence[ObjectEstimate] = ()

    def sample(
        self,
        time: float,
        joints: Float[np.ndarray, "_j"],
        width: float,
        poses: Float[np.ndarray, "_b 7"] | None = None,
    ) -> None:
        """Append a sample at a simulated time in seconds."""
        if self.times:
            self.now += max(time - self.times[-1], 0.0)
        self.times.append(time)
        self.joints.append(joints)
        self.widths.append(width)
        self.poses.append(np.zeros((len(self.bodies), 7)) if poses is None else poses)
        self.show_times.append(self.now)  # last: readers take as many samples as there are times

    def note(self, kind: NoteKind, **data: Any) -> None:
        """Append a note and advance the show time by its duration."""
        self.notes.append(Note(self.now, kind, data))
        self.now += BEAT.get(kind, 0.0)

    def write(self, folder: Path) -> None:
        """Write everything but the meshes."""
        actions = [note for note in self.notes if note.kind in ("stage", "action")]
        labels = [note.data["name"] if note.kind == "stage" else action_text(note.data) for note in actions]
        arrays = {
            "show_time": np.array(self.show_times),
            "time": np.array(self.times),
            "joint_positions": np.array(self.joints) if self.joints else np.zeros((0, 0)),
            "gripper_width": np.array(self.widths),
            "body_poses": np.array(self.poses or np.zeros((0, len(self.bodies), 7)), dtype=np.float32),
            "event_time": np.array([self.simulated(note.time) for note in actions]),
            "event": np.array(labels, dtype=np.str_),
        }
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        write_atomically(folder / "replay.npz", buffer.getvalue())
        notes = [[round(note.time, 4), note.kind, _plain(note.data)] for note in self.notes]
        text = json.dumps({"bodies": self.bodies, "notes": notes}, separators=(",", ":"))
        write_atomically(folder / "replay.json", text.encode())

    def write_meshes(self, folder: Path) -> None:
        """Write the visual meshes as one GLB file."""
        scene = trimesh.Scene()
        for body, parts in self.meshes.items():
            for index, mesh in enumerate(parts):
                scene.add_geometry(mesh, node_name=f"{body}/{index}", geom_name=f"{body}/{index}")
        if self.meshes:
            glb = scene.export(file_type="glb")
            assert isinstance(glb, bytes)
            write_atomically(folder / "replay.glb", glb)

    def simulated(self, show_time: float) -> float:
        """Return the simulated time at a show time, both in seconds."""
        index = np.searchsorted(self.show_times, show_time, side="right") - 1
        return self.times[index] if index >= 0 else 0.0


def action_text(action: Mapping[str, Any]) -> str:
    """Return a short description of an action."""
    return f"{action['phase']} {action['name']}".replace("_", " ")


def read_recording(folder: Path) -> Recorder:
    """Read what ``Recorder`` wrote.

    Raises:
        InvalidInputError: A file is missing or malformed; the message names it.
    """
    remedy = "give a run folder that `pack` or `sort` wrote"
    bodies, notes = _read_notes(folder / "replay.json", remedy)
    arrays = _read_arrays(folder / "replay.npz", remedy)
    try:
        _check_arrays(arrays)
        if bodies and not len(arrays["show_time"]):
            raise ValueError("there is no sample of the bodies")
        poses = arrays["body_poses"].reshape(len(arrays["show_time"]), len(bodies), 7)
    except ValueError as error:
        raise InvalidInputError(
            f"{folder}: replay.json and replay.npz do not belong together ({error}): run it again"
        ) from None
    return Recorder(
        bodies=bodies,
        meshes=_read_meshes(folder / "replay.glb"),
        now=max([note.time for note in notes] + arrays["show_time"].tolist()[-1:] + [0.0]),
        show_times=arrays["show_time"].tolist(),
        times=arrays["time"].tolist(),
        joints=list(arrays["joint_positions"]),
        widths=arrays["gripper_width"].tolist(),
        poses=list(poses.astype(np.float64)),
        notes=notes,
    )


def _read_notes(path: Path, remedy: str) -> tuple[tuple[str, ...], list[Note]]:
    """Read the names of the bodies and the notes, in order of time."""
    content = read_json(path, remedy)
    lists = isinstance(content, dict) and all(
        isinstance(content.get(key), list) for key in ("bodies", "notes")
    )
    names = content["bodies"] if lists else []
    if not lists or not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
        raise InvalidInputError(f"{path} must hold the lists bodies, of different names, and notes: {remedy}")
    notes: list[Note] = []
    for index, entry in enumerate(content["notes"]):
        try:
            note = _note(entry)
            if notes and note.time < notes[-1].time:
                raise ValueError("its time is before that of the previous note")
        except ValueError as error:
            raise InvalidInputError(f"{path}, note {index}: {error}: run it again") from None
        notes.append(note)
    return tuple(content["bodies"]), notes


def _note(entry: Any) -> Note:
    if not isinstance(entry, list) or len(entry) != 3 or not isinstance(entry[2], dict):
        raise ValueError("it must be [time, kind, {...}]")
    time, kind, data = entry
    if not is_finite_number(time) or not 0 <= time <= MAX_TIME:
        raise ValueError(f"its time must be a number from 0 to {MAX_TIME:g} s")
    kind = _kind(kind)
    check_note(kind, data)
    return Note(float(time), kind, data)


def _kind(kind: Any) -> NoteKind:
    for known in get_args(NoteKind):
        if kind == known:
            return known
    raise ValueError(f"there is no note of kind {kind!r}")


def _check_arrays(arrays: Mapping[str, np.ndarray]) -> None:
    """Check names, numbers and lengths of the arrays of samples.

    Raises:
        ValueError: An array is missing or invalid; the message names it.
    """
    for name in ("show_time", "time", "joint_positions", "gripper_width", "body_poses"):
        if name not in arrays:
            raise ValueError(f"{name} is missing")
        array = arrays[name]
        if array.ndim == 0 or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            raise ValueError(f"{name} must hold finite numbers")
        if len(array) != len(arrays["show_time"]):
            raise ValueError(f"{name} has {len(array)} samples, show_time {len(arrays['show_time'])}")
    if np.abs(arrays["body_poses"]).max(initial=0.0) > MAX_LENGTH:
        raise ValueError(f"body_poses must be within {MAX_LENGTH:g} m")
    for name in ("show_time", "time"):
        times = arrays[name]
        if times.ndim != 1 or (np.diff(times) < 0).any():
            raise ValueError(f"{name} must be in ascending order")
        if (times < 0).any() or (times > MAX_TIME).any():
            raise ValueError(f"{name} must be from 0 to {MAX_TIME:g} s")


def _read_arrays(path: Path, remedy: str) -> dict[str, np.ndarray]:
    try:
        return read_arrays(path)
    except FileNotFoundError:
        raise InvalidInputError(f"{path} is missing: {remedy}") from None
    except (ValueError, OSError) as error:
        raise InvalidInputError(f"{path} is not a readable replay ({error}): {remedy}") from None


def _read_meshes(path: Path) -> dict[str, tuple[trimesh.Trimesh, ...]]:
    """Read the meshes by body; empty if the file is missing, since the rest can be shown without them."""
    if not path.is_file():
        return {}
    try:
        scene = read_mesh_scene(path)
        parts: dict[str, list[trimesh.Trimesh]] = {}
        for node in sorted(scene.graph.nodes_geometry):
            mesh = scene.geometry[scene.graph[node][1]]
            if not isinstance(mesh, trimesh.Trimesh):
                raise ValueError(f"{node} is not a triangle mesh")
            if not np.isfinite(mesh.vertices).all():
                raise ValueError(f"{node} has vertices that are not finite")
            parts.setdefault(str(node).rpartition("/")[0], []).append(mesh)
    except Exception as error:  # whatever the parser meets
        raise InvalidInputError(
            f"{path} is not a readable GLB file ({error}): delete it or run again"
        ) from None
    return {body: tuple(meshes) for body, meshes in parts.items()}


def _plain(value: Any) -> Any:
    """Convert arrays to lists of rounded numbers."""
    if isinstance(value, np.ndarray):
        return np.round(value.astype(np.float64), 5).tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(entry) for entry in value]
    return value
