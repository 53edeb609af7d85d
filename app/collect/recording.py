"""One recorded episode: the frames that the expert saw, its actions, and the true states of the objects."""

from __future__ import annotations

import io
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from app.environments.environment import CAMERAS, CellEnv
from app.environments.expert import Expert
from app.environments.privileged import COLUMNS
from app.environments.registration import MAX_SECONDS
from app.movie import Encoding, MovieFile
from perception.types import CATEGORIES

GOP = 2  # frames between key frames, so that single frames are decoded quickly
QUALITY = 25  # of x264: constant rate factor
ENCODING = Encoding(
    quality=None,
    block=2,
    parameters=("-crf", str(QUALITY), "-g", str(GOP), "-preset", "veryfast", "-threads", "1"),
)
STATS_STRIDE = 10  # every tenth image enters the statistics

Stats = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Episode:
    """One episode in the form in which workers return it.

    Attributes:
        files: Content of its files by name: ``frames.parquet``, ``objects.parquet``, and a video per camera.
        n_frames: Number of frames.
        success: Whether all objects were in place at the end.
        placed: Number of objects in place at the end.
        n_objects: Number of objects.
        failure: Error that ended the expert's pipeline; empty if none did.
        stats: Statistics of each feature, as LeRobot stores them.
    """

    files: dict[str, bytes]
    n_frames: int
    success: bool
    placed: int
    n_objects: int
    failure: str
    stats: Stats


def record(env: CellEnv, expert: Expert, seed: int) -> Episode:
    """Let the expert act in the cell of a seed until the task is done or the expert has finished.

    Images are recorded if observations have them.
    """
    observation, info = env.reset(seed=seed)
    expert.reset(observation)
    columns: dict[str, list[Any]] = defaultdict(list)
    objects: list[np.ndarray] = []
    placed: list[np.ndarray] = []
    videos = {name: _Video(round(env.rate)) for name in CAMERAS if name in observation}
    max_frames = round(MAX_SECONDS * env.rate)
    done = False
    while not done and len(objects) < max_frames:
        action = expert.act(observation)
        if expert.finished:
            break
        columns["observation.state"].append(observation["state"])
        columns["action"].append(action)
        columns["phase"].append(expert.phase)
        columns["target"].append(expert.target)
        objects.append(env.object_states())
        placed.append(info["placed"])
        for name, video in videos.items():
            video.add(observation[name])
        observation, reward, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        columns["next.reward"].append(np.float32(reward))
        columns["next.success"].append(info["success"])
    columns["next.done"] = [False] * (len(objects) - 1) + [True] if objects else []
    files = {
        "frames.parquet": parquet_bytes(_frames_table(columns, env.rate)),
        "objects.parquet": parquet_bytes(_objects_table(np.array(objects), np.array(placed), env)),
    }
    files |= {f"{name}.mp4": video.finish() for name, video in videos.items()}
    numeric = ("observation.state", "action", "next.reward")
    stats = {name: stats_of(np.array(columns[name])) for name in numeric}
    stats |= {f"observation.images.{name}": video.stats() for name, video in videos.items()}
    return Episode(
        files=files,
        n_frames=len(objects),
        success=bool(info["success"]),
        placed=int(info["placed"].sum()),
        n_objects=len(info["placed"]),
        failure=expert.failure,
        stats=stats,
    )


def stats_of(values: np.ndarray) -> dict[str, Any]:
    """Return minimum, maximum, mean, standard deviation and count over the first axis."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    figures = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    return {name: figure.tolist() for name, figure in figures.items()} | {"count": [len(rows)]}


def parquet_bytes(table: pa.Table) -> bytes:
    """Return a table as a Parquet file."""
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def _frames_table(columns: dict[str, list[Any]], rate: float) -> pa.Table:
    count = len(columns["action"])
    arrays: dict[str, pa.Array] = {
        name: pa.FixedSizeListArray.from_arrays(pa.array(np.concatenate(rows), pa.float32()), len(rows[0]))
        for name, rows in columns.items()
        if name in ("observation.state", "action")
    }
    arrays["phase"] = pa.array(columns["phase"], pa.string())
    arrays["target"] = pa.array(columns["target"], pa.string())
    arrays["next.reward"] = pa.array(columns["next.reward"], pa.float32())
    arrays["next.success"] = pa.array(columns["next.success"], pa.bool_())
    arrays["next.done"] = pa.array(columns["next.done"], pa.bool_())
    arrays["timestamp"] = pa.array(np.arange(count) / rate, pa.float32())
    arrays["frame_index"] = pa.array(np.arange(count), pa.int64())
    return pa.table(arrays)


def _objects_table(states: np.ndarray, placed: np.ndarray, env: CellEnv) -> pa.Table:
    """Return one row per frame and object.

    Args:
        states: (frames, objects, columns) states.
        placed: (frames, objects) whether each is in place.
        env: The environment.
    """
    frames, count, _ = states.shape
    table = {
        "frame_index": np.repeat(np.arange(frames), count),
        "object_index": np.tile(np.arange(count), frames),
        "category": list(env.categories) * frames,
    }
    table |= {name: states[:, :, i].ravel() for i, name in enumerate(COLUMNS) if name not in CATEGORIES}
    return pa.table(table | {"placed": placed.ravel()})


class _Video:
    """Encodes images of one camera, and keeps a few for the statistics."""

    def __init__(self, fps: int) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._path = Path(self._folder.name) / "video.mp4"
        self._kept: list[np.ndarray] = []
        self._count = 0
        self._file = MovieFile(self._path, fps, ENCODING, animation=False)

    def add(self, image: np.ndarray) -> None:
        if self._count % STATS_STRIDE == 0:
            self._kept.append(image)
        self._count += 1
        self._file.add(image)

    def finish(self) -> bytes:
        """Return the file; empty without images.

        Raises:
            OSError: The encoder failed, as on a full disk.
        """
        with self._folder:
            if not self._count:
                self._file.discard()
                return b""
            self._file.close()
            return self._path.read_bytes()

    def stats(self) -> dict[str, Any]:
        """Return statistics per channel, of values in 0..1, in LeRobot's shape (3, 1, 1)."""
        pixels = np.array(self._kept, dtype=np.float32).reshape(-1, 3) / 255
        figures = stats_of(pixels)
        per_channel = ("min", "max", "mean", "std")
        shaped = {name: np.reshape(figures[name], (3, 1, 1)).tolist() for name in per_channel}
        return shaped | {"count": [len(self._kept)]}
