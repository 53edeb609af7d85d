"""Assembles recorded episodes into a LeRobot data set, format v3.0.

Layout, as read by the package ``lerobot``:

    meta/info.json, meta/stats.json, meta/tasks.parquet, meta/episodes/chunk-000/file-000.parquet
    data/chunk-000/file-000.parquet                          frames of many episodes
    videos/observation.images.<camera>/chunk-000/file-000.mp4    one file per episode
    privileged/chunk-000/file-000.parquet                    true states of the objects; not read by lerobot

The data set depends on the episodes alone, in whatever order they were recorded. ``meta/info.json``, written
last, marks it as complete.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from app.collect.recording import parquet_bytes
from app.runs.manifest import own_names
from perception.io.files import read_json, write_atomically, write_json

VERSION = "v3.0"
PARTS = "episodes"  # folder of the recorded episodes
FILES_PER_CHUNK = 1000
MAX_DATA_BYTES = 100 * 2**20  # of the tables in one data file
MAX_VIDEO_MB = 200  # declared only: every episode has a file of its own

Line = dict[str, Any]


@dataclass(frozen=True)
class DatasetConfig:
    """What all episodes share.

    Attributes:
        robot: Name of the robot.
        fps: Frames per second.
        instruction: The task in one sentence.
        state_names: Name of each number of ``observation.state``.
        action_names: Name of each number of ``action``.
        cameras: Names of the cameras.
        image_size: Width and height of the images in pixels.
    """

    robot: str
    fps: int
    instruction: str
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    cameras: tuple[str, ...]
    image_size: tuple[int, int]

    @property
    def features(self) -> dict[str, Any]:
        """Description of each column, as in ``meta/info.json``."""
        width, height = self.image_size
        video = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height, "video.width": width, "video.codec": "h264",
                "video.pix_fmt": "yuv420p", "video.is_depth_map": False, "video.fps": self.fps,
                "video.channels": 3, "has_audio": False,
            },
        }  # fmt: skip
        return {
            "observation.state": _feature("float32", len(self.state_names), self.state_names),
            "action": _feature("float32", len(self.action_names), self.action_names),
            **{f"observation.images.{name}": video for name in self.cameras},
            "phase": _feature("string"),
            "target": _feature("string"),
            "next.reward": _feature("float32"),
            "next.success": _feature("bool"),
            "next.done": _feature("bool"),
            "timestamp": _feature("float32"),
            **{name: _feature("int64") for name in ("frame_index", "episode_index", "index", "task_index")},
        }


def assemble(folder: Path, lines: Sequence[Line], config: DatasetConfig) -> None:
    """Write the data set of the given episodes; their own folders remain, so that it can be repeated.

    Args:
        folder: Folder of the data set, with ``episodes/<seed>/``.
        lines: Ledger lines of the episodes, in the order of the data set.
        config: What they share.
    """
    for name in own_names(folder):  # of an assembly that was interrupted
        if name.startswith(("data/", "meta/", "privileged/", "videos/")):
            (folder / name).unlink()
    parts = [folder / PARTS / str(line["seed"]) for line in lines]
    located = _write_tables(folder, "data", parts, "frames.parquet")
    _write_tables(folder, "privileged", parts, "objects.parquet", indexed=False)
    begins = np.concatenate([[0], np.cumsum([line["n_frames"] for line in lines])]).tolist()
    rows = []
    for number, (line, part) in enumerate(zip(lines, parts, strict=True)):
        row: dict[str, Any] = {
            "episode_index": number,
            "tasks": [config.instruction],
            "length": line["n_frames"],
            "data/chunk_index": located[number] // FILES_PER_CHUNK,
            "data/file_index": located[number] % FILES_PER_CHUNK,
            "dataset_from_index": begins[number],
            "dataset_to_index": begins[number + 1],
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            "seed": line["seed"],
            "success": line["success"],
        }
        for camera in config.cameras:
            key = f"videos/observation.images.{camera}"
            chunk, file = divmod(number, FILES_PER_CHUNK)
            _link(part / f"{camera}.mp4", folder / f"{key}/{_numbered(chunk, file)}.mp4")
            row |= {
                f"{key}/chunk_index": chunk,
                f"{key}/file_index": file,
                f"{key}/from_timestamp": 0.0,
                f"{key}/to_timestamp": line["n_frames"] / config.fps,
            }
        for feature, figures in line["stats"].items():
            row |= {f"stats/{feature}/{name}": value for name, value in figures.items()}
        rows.append(row)
    episodes = parquet_bytes(pa.Table.from_pylist(rows))
    write_atomically(folder / f"meta/episodes/{_numbered(0, 0)}.parquet", episodes)
    tasks = pa.table({"task_index": pa.array([0], pa.int64()), "task": [config.instruction]})
    write_atomically(folder / "meta/tasks.parquet", parquet_bytes(_indexed_by(tasks, "task")))
    write_json(folder / "meta/stats.json", aggregate([line["stats"] for line in lines]))
    write_json(folder / "meta/info.json", _info(config, lines))


def check_part(folder: Path, seed: int, n_frames: int, cameras: Sequence[str]) -> None:
    """Raise ValueError unless the files of an episode are there, with its number of frames."""
    part = folder / PARTS / str(seed)
    for path in (part / "objects.parquet", *(part / f"{camera}.mp4" for camera in cameras)):
        if not path.is_file() or not path.stat().st_size:
            raise ValueError(f"{path} is missing")
    n_rows = pq.read_metadata(part / "frames.parquet").num_rows
    if n_rows != n_frames:
        raise ValueError(f"{part} has {n_rows} frames, not {n_frames}")


def n_assembled(folder: Path) -> int | None:
    """Return the number of episodes in a complete data set; None if the folder holds none.

    Raises:
        InvalidInputError: ``meta/info.json`` is damaged.
    """
    path = folder / "meta/info.json"
    if not path.exists():
        return None
    info = read_json(path, "give another --out")
    return info.get("total_episodes") if isinstance(info, dict) else None


def remove_parts(folder: Path) -> None:
    """Remove the recorded episodes from which a data set was assembled."""
    for part in (folder / PARTS).glob("*/*"):
        part.unlink()


def aggregate(stats: Sequence[dict[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Return the statistics of all episodes together from those of each."""
    together = {}
    for feature in stats[0] if stats else ():
        figures = {
            name: np.array([row[feature][name] for row in stats]) for name in ("min", "max", "mean", "std")
        }
        counts = np.array([row[feature]["count"][0] for row in stats], dtype=np.float64)
        weights = (counts / counts.sum()).reshape(-1, *[1] * (figures["mean"].ndim - 1))
        mean = (weights * figures["mean"]).sum(axis=0)
        variance = (weights * (figures["std"] ** 2 + (figures["mean"] - mean) ** 2)).sum(axis=0)
        together[feature] = {
            "min": figures["min"].min(axis=0).tolist(),
            "max": figures["max"].max(axis=0).tolist(),
            "mean": mean.tolist(),
            "std": np.sqrt(variance).tolist(),
            "count": [int(counts.sum())],
        }
    return together


def _write_tables(
    folder: Path, kind: str, parts: Sequence[Path], name: str, indexed: bool = True
) -> dict[int, int]:
    """Join the episodes' tables into numbered files; return the number of the file of each episode."""
    located: dict[int, int] = {}
    for file, (numbers, table) in enumerate(_joined(parts, name, indexed)):
        located |= dict.fromkeys(numbers, file)
        path = folder / kind / f"{_numbered(*divmod(file, FILES_PER_CHUNK))}.parquet"
        write_atomically(path, parquet_bytes(table))
    return located


def _joined(parts: Sequence[Path], name: str, indexed: bool) -> Iterator[tuple[list[int], pa.Table]]:
    """Yield groups of episodes whose joined table has the size of a file."""
    numbers: list[int] = []
    tables: list[pa.Table] = []
    begin = 0
    for number, part in enumerate(parts):
        table = pq.read_table(part / name)
        table = table.append_column("episode_index", pa.array([number] * len(table), pa.int64()))
        if indexed:
            table = table.append_column("index", pa.array(range(begin, begin + len(table)), pa.int64()))
            table = table.append_column("task_index", pa.array([0] * len(table), pa.int64()))
        begin += len(table)
        numbers.append(number)
        tables.append(table)
        if sum(table.nbytes for table in tables) > MAX_DATA_BYTES:
            yield numbers, pa.concat_tables(tables)
            numbers, tables = [], []
    if tables:
        yield numbers, pa.concat_tables(tables)


def _info(config: DatasetConfig, lines: Sequence[Line]) -> dict[str, Any]:
    return {
        "codebase_version": VERSION,
        "robot_type": config.robot,
        "total_episodes": len(lines),
        "total_frames": sum(line["n_frames"] for line in lines),
        "total_tasks": 1,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": MAX_DATA_BYTES // 2**20,
        "video_files_size_in_mb": MAX_VIDEO_MB,
        "fps": config.fps,
        "splits": {"train": f"0:{len(lines)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        if config.cameras
        else None,
        "features": config.features,
    }


def _feature(dtype: str, size: int = 1, names: Sequence[str] | None = None) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [size], "names": list(names) if names else None}


def _numbered(chunk: int, file: int) -> str:
    return f"chunk-{chunk:03d}/file-{file:03d}"


def _indexed_by(table: pa.Table, column: str) -> pa.Table:
    """Return the table with the metadata by which pandas takes a column as the index."""
    import json

    metadata = {
        "index_columns": [column],
        "column_indexes": [],
        "columns": [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
            for name, kind, numpy in (("task_index", "int64", "int64"), (column, "unicode", "object"))
        ],
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(metadata)})


def _link(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it where the file system has no links."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
