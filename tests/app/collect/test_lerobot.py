"""The data set on disk: indices, locations of the episodes, statistics, independence of the order."""

import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from app.collect import lerobot
from app.collect.lerobot import aggregate, assemble, check_part, n_assembled, remove_parts
from app.collect.recording import parquet_bytes, record, stats_of


@pytest.fixture
def stored(tmp_path, short):
    """Store two episodes of 3 and 2 frames as the command does; return their ledger lines."""
    lines = []
    for seed, length in ((7, 3), (9, 2)):
        episode = record(*short(length), seed=seed)
        folder = tmp_path / "episodes" / str(seed)
        folder.mkdir(parents=True)
        for name, content in episode.files.items():
            (folder / name).write_bytes(content)
        lines.append(
            {
                "seed": seed,
                "n_frames": length,
                "success": True,
                "stats": json.loads(json.dumps(episode.stats)),
            }
        )
    return tmp_path, lines


def test_frames_are_numbered_through(stored, config):
    folder, lines = stored
    assemble(folder, lines, config)
    frames = pq.read_table(folder / "data/chunk-000/file-000.parquet").to_pydict()
    assert frames["index"] == [0, 1, 2, 3, 4] and frames["episode_index"] == [0, 0, 0, 1, 1]
    assert frames["frame_index"] == [0, 1, 2, 0, 1] and frames["task_index"] == [0] * 5
    assert set(frames) == {key for key, entry in config.features.items() if entry["dtype"] != "video"}
    objects = pq.read_table(folder / "privileged/chunk-000/file-000.parquet").to_pydict()
    assert objects["episode_index"] == [0] * 6 + [1] * 4


def test_episodes_are_located(stored, config):
    folder, lines = stored
    assemble(folder, lines, config)
    rows = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(row["dataset_from_index"], row["dataset_to_index"], row["seed"]) for row in rows] == [
        (0, 3, 7),
        (3, 5, 9),
    ]
    for row in rows:
        for camera in config.cameras:
            key = f"videos/observation.images.{camera}"
            assert row[f"{key}/to_timestamp"] == pytest.approx(row["length"] / 20)
            name = f"chunk-{row[f'{key}/chunk_index']:03d}/file-{row[f'{key}/file_index']:03d}.mp4"
            assert (folder / key / name).is_file()


def test_an_interrupted_assembly_is_repeated(stored, config):
    folder, lines = stored
    assemble(folder, lines, config)
    whole = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    (folder / "meta/info.json").unlink()
    assert n_assembled(folder) is None
    assemble(folder, lines, config)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == whole
    remove_parts(folder)
    assert n_assembled(folder) == 2 and not list((folder / "episodes").glob("*/*"))
    assert {path.parts[-4] for path in folder.rglob("*.mp4")} == {"videos"}


def test_the_description_fits_the_content(stored, config):
    folder, lines = stored
    assemble(folder, lines, config)
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["total_episodes"], info["total_frames"], info["codebase_version"]) == (2, 5, "v3.0")
    assert info["features"]["observation.images.wrist"]["shape"] == [48, 64, 3]
    tasks = pq.read_table(folder / "meta/tasks.parquet").to_pandas()
    assert tasks.index.tolist() == ["Pack."] and tasks["task_index"].tolist() == [0]
    assert set(json.loads((folder / "meta/stats.json").read_text())) >= {"action", "observation.images.scene"}


def test_without_cameras(stored, config):
    folder, lines = stored
    assemble(folder, lines, replace(config, cameras=()))
    assert json.loads((folder / "meta/info.json").read_text())["video_path"] is None


def test_large_sets_have_several_files(stored, config, monkeypatch):
    folder, lines = stored
    monkeypatch.setattr(lerobot, "MAX_DATA_BYTES", 1)
    assemble(folder, lines, config)
    rows = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["data/file_index"] for row in rows] == [0, 1]
    assert len(pq.read_table(folder / "data/chunk-000/file-001.parquet")) == 2


def test_statistics_of_parts_are_those_of_the_whole():
    values = np.random.default_rng(0).normal(size=(50, 3))
    parts = [{"x": stats_of(values[:13])}, {"x": stats_of(values[13:])}]
    together, whole = aggregate(parts)["x"], stats_of(values)
    for name, figure in whole.items():
        np.testing.assert_allclose(together[name], figure)


def test_an_episode_is_whole_with_all_its_files_and_frames(tmp_path):
    part = tmp_path / "episodes/7"
    part.mkdir(parents=True)
    for name in ("frames.parquet", "objects.parquet"):
        (part / name).write_bytes(parquet_bytes(pa.table({"x": [1, 2, 3]})))
    check_part(tmp_path, 7, 3, ())
    with pytest.raises(ValueError, match="3 frames, not 4"):
        check_part(tmp_path, 7, 4, ())
    with pytest.raises(ValueError, match=r"wrist\.mp4 is missing"):
        check_part(tmp_path, 7, 3, ("wrist",))
