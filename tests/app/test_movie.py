"""Video and animation of the same film."""

import gc

import cv2
import numpy as np
import pytest
from PIL import Image, ImageSequence

from app.movie import ANIMATION_FPS, ANIMATION_WIDTH, LONGEST, Encoding, MovieFile, is_complete_mp4


def grey(value):
    return np.full((240, 960, 3), value, np.uint8)


def played(path):
    """Size of an animation, and of each image its mean brightness and duration in [ms]."""
    with Image.open(path) as animation:
        images = [
            (np.asarray(image.convert("RGB")).mean(), image.info["duration"])
            for image in ImageSequence.Iterator(animation)
        ]
        return animation.size, *zip(*images, strict=True)


def test_the_animation_shows_the_film_smaller_and_in_the_same_time(tmp_path):
    movie = MovieFile(tmp_path / "video.mp4", 12)
    for value in range(0, 240, 10):
        movie.add(grey(value))
    movie.hold(1.0)
    assert not list(tmp_path.glob("video.*"))  # nothing that looks complete
    movie.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["video.mp4", "video.webp"]
    film = cv2.VideoCapture(str(tmp_path / "video.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 36
    film.release()
    size, values, durations = played(tmp_path / "video.webp")
    assert size == (ANIMATION_WIDTH, 160)
    assert np.isclose(values[0], 0, atol=3) and np.isclose(values[-1], 230, atol=8)
    assert np.isclose(sum(durations), 3000, atol=20) and np.diff(values).min() >= 0


def test_long_films_make_short_animations_and_given_up_ones_none(tmp_path):
    movie = MovieFile(tmp_path / "long.mp4", 1)
    for value in range(30):
        movie.add(grey(8 * value))
    movie.close()
    _, values, durations = played(tmp_path / "long.webp")
    assert len(values) == 30 <= ANIMATION_FPS * LONGEST
    assert np.isclose(sum(durations), 1000 * LONGEST, rtol=0.01)
    other = MovieFile(tmp_path / "other.mp4", 12)
    other.add(grey(0))
    other.discard()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["long.mp4", "long.webp"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_full_disk_is_an_error_and_leaves_no_video(tmp_path):
    """The encoder's library leaves its pipe to the garbage collector."""
    (tmp_path / ".video.mp4.partial.mp4").symlink_to("/dev/full")  # every write fails
    movie = MovieFile(tmp_path / "video.mp4", 12)
    with pytest.raises(OSError, match=r"video\.mp4") as caught:
        for value in range(200):
            movie.add(grey(value))
        movie.close()
    assert "ffmpeg" not in str(caught.value).lower()
    movie.discard()
    assert not list(tmp_path.iterdir())
    del movie, caught
    gc.collect()


def test_truncated_videos_are_recognised(tmp_path):
    movie = MovieFile(tmp_path / "video.mp4", 12)
    movie.add(grey(0))
    movie.close()
    content = (tmp_path / "video.mp4").read_bytes()
    assert is_complete_mp4(tmp_path / "video.mp4")
    for length in (0, 4, 40, len(content) // 2, len(content) - 1):
        (tmp_path / "cut.mp4").write_bytes(content[:length])
        assert not is_complete_mp4(tmp_path / "cut.mp4")


def test_the_animation_is_optional(tmp_path):
    movie = MovieFile(tmp_path / "plain.mp4", 10, Encoding(block=2), animation=False)
    movie.add(np.zeros((34, 50, 3), np.uint8))
    movie.close()
    assert [path.name for path in tmp_path.iterdir()] == ["plain.mp4"]
