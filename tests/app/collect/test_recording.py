"""Recorded episodes: frames before actions, rewards after them, true states, videos, statistics."""

import io

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from app.collect.recording import _Video, parquet_bytes, record, stats_of


def table(episode, name):
    return pq.read_table(io.BytesIO(episode.files[name])).to_pydict()


def test_each_frame_has_what_was_seen_and_then_done(short):
    episode = record(*short(), seed=5)
    frames = table(episode, "frames.parquet")
    assert episode.n_frames == 3 and episode.success and (episode.placed, episode.n_objects) == (2, 2)
    assert frames["observation.state"] == [[0, 1, 2], [1, 2, 3], [2, 3, 4]]
    np.testing.assert_allclose(frames["action"], [[1, 0.08], [2, 0.08], [3, 0.08]])
    assert frames["next.reward"] == [0, 0, 1] and frames["next.success"] == [False, False, True]
    assert frames["next.done"] == [False, False, True] and frames["frame_index"] == [0, 1, 2]
    np.testing.assert_allclose(frames["timestamp"], [0, 0.05, 0.10])
    assert frames["phase"] == ["scan"] * 3


def test_true_states_are_a_table_of_their_own(short):
    objects = table(record(*short(), seed=5), "objects.parquet")
    assert objects["frame_index"] == [0, 0, 1, 1, 2, 2] and objects["object_index"] == [0, 1] * 3
    assert objects["category"] == ["can", "mug"] * 3 and objects["x"] == [0, 0, 1, 1, 2, 2]
    assert objects["placed"] == [False] * 6 and "can" not in objects


def test_an_expert_that_gives_up_fails_the_episode(short):
    episode = record(*short(length=9, patience=2), seed=0)
    assert (episode.n_frames, episode.success, episode.failure) == (2, False, "no plan")
    assert table(episode, "frames.parquet")["next.done"] == [False, True]


def test_videos_have_one_image_per_frame(short, tmp_path):
    episode = record(*short(), seed=0)
    for name in ("wrist", "scene"):
        path = tmp_path / f"{name}.mp4"
        path.write_bytes(episode.files[path.name])
        film = cv2.VideoCapture(str(path))
        images = [film.read()[1] for _ in range(3)]
        assert not film.read()[0] and images[0].shape == (48, 64, 3)
        assert [float(image.mean()) for image in images] == pytest.approx([0, 50, 100], abs=6)
    assert np.shape(episode.stats["observation.images.wrist"]["mean"]) == (3, 1, 1)


def test_equal_episodes_have_equal_files(short):
    first, second = (record(*short(), seed=0) for _ in range(2))
    assert first.files == second.files


def test_no_images(short):
    assert set(record(*short(images=False), seed=0).files) == {"frames.parquet", "objects.parquet"}


def test_statistics_by_hand():
    assert stats_of(np.array([[1.0, 0.0], [3.0, 0.0]])) == {
        "min": [1, 0], "max": [3, 0], "mean": [2, 0], "std": [1, 0], "count": [2],
    }  # fmt: skip


def test_tables_survive_the_file():
    import pyarrow as pa

    assert pq.read_table(io.BytesIO(parquet_bytes(pa.table({"a": [1, 2]})))).to_pydict() == {"a": [1, 2]}


def test_a_failing_encoder_is_noticed(tmp_path):
    video = _Video(10)
    video.add(np.zeros((32, 32, 3), np.uint8))
    video._file._writer.close()
    video._path.with_name(".video.mp4.partial.mp4").write_bytes(b"cut")
    with pytest.raises(OSError, match=r"video\.mp4"):
        video.finish()


def test_a_video_without_images_is_empty():
    assert _Video(10).finish() == b""
