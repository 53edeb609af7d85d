"""TUM RGB-D recordings: pairing by time, units, cameras, malformed lists."""

import numpy as np
import pytest
from PIL import Image

from perception.errors import InvalidInputError
from perception.io.recordings.sequence import open_sequence
from perception.io.recordings.tum import CAMERAS, DEFAULT_CAMERA, _nearest, is_tum_recording, open_tum


@pytest.fixture
def tum(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg2_desk"
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for k in range(3):
        Image.fromarray(np.full((48, 64, 3), 10 * k, np.uint8)).save(folder / "rgb" / f"{k}.png")
        Image.fromarray(np.full((48, 64), 5000 * (k + 1), np.uint16)).save(folder / "depth" / f"{k}.png")
    rgb = "\n".join(f"{k + 0.005} rgb/{k}.png" for k in range(3))
    depth = "\n".join(f"{k + (0.5 if k == 1 else 0)} depth/{k}.png" for k in range(3))
    (folder / "rgb.txt").write_text(f"# colour\n{rgb}\n")
    (folder / "depth.txt").write_text(f"# depth\n{depth}\n")
    return folder


def test_tum_images_are_paired_by_time(tum):
    sequence = open_sequence(tum)
    frames = [frame for _, frame in sequence.frames()]
    assert [frame.time for frame in frames] == [0, 2]  # the second depth image is 0.5 s from any colour image
    assert frames[1].depth[0, 0] == pytest.approx(3.0) and frames[1].rgb[0, 0, 0] == 20
    fx, _, cx, _ = np.array(CAMERAS["freiburg2"][:4]) / 10  # the images here are a tenth as wide
    assert frames[0].intrinsics.fx == pytest.approx(fx) and frames[0].intrinsics.cx == pytest.approx(cx)
    assert sequence.detections(0, frames[0]) is None


def test_tum_intrinsics_can_be_given(tum):
    (tum / "intrinsics.txt").write_text("60 61 32 24")
    assert open_tum(tum).read(0).intrinsics.fy == 61  # in pixels of these images, which are 64 wide
    (tum / "intrinsics.txt").write_text("600 601")
    with pytest.raises(InvalidInputError, match=r"intrinsics\.txt holds no intrinsics \(2 numbers\)"):
        open_tum(tum)


def test_an_unknown_tum_camera_gets_the_default(tum):
    office = tum.rename(tum.with_name("office"))
    assert open_tum(office).camera == DEFAULT_CAMERA
    listed = (office / "rgb.txt").read_text()
    (office / "rgb.txt").write_text("# file: 'rgbd_dataset_freiburg3_desk.bag'\n" + listed)
    assert open_tum(office).camera == CAMERAS["freiburg3"]


def test_listed_images_that_are_missing_are_counted(tum):
    (tum / "rgb/0.png").unlink()
    recording = open_tum(tum)
    assert recording.n_missing == 1 and [pair.color for pair in recording.pairs] == ["rgb/2.png"]
    (tum / "rgb/2.png").unlink()
    with pytest.raises(InvalidInputError, match=r"none of the 2 listed image pairs, such as rgb/0\.png"):
        open_tum(tum)


@pytest.mark.parametrize(("difference", "paired"), [(0.019, 1), (-0.019, 1), (0.021, 0), (-0.021, 0)])
def test_images_are_paired_within_20_ms(tum, difference, paired):
    (tum / "rgb.txt").write_text("10.0 rgb/0.png\n")
    (tum / "depth.txt").write_text(f"{10 + difference} depth/0.png\n")
    if paired:
        assert open_tum(tum).pairs == ((10 + difference, "rgb/0.png", "depth/0.png"),)
    else:
        with pytest.raises(InvalidInputError, match="no depth image has a colour image within 20 ms"):
            open_tum(tum)


def test_each_depth_image_gets_the_nearest_colour_image_and_each_colour_image_one(tum):
    (tum / "rgb.txt").write_text("1.00 rgb/0.png\n1.01 rgb/1.png\n")
    (tum / "depth.txt").write_text("1.012 depth/1.png\n1.002 depth/0.png\n1.004 depth/2.png\n")
    assert [(p.color, p.depth) for p in open_tum(tum).pairs] == [
        ("rgb/0.png", "depth/0.png"),
        ("rgb/1.png", "depth/1.png"),
    ]


def test_both_lists_make_a_recording(tum):
    assert is_tum_recording(tum)
    (tum / "depth.txt").write_text("# nothing\n")
    with pytest.raises(InvalidInputError, match=r"depth\.txt lists no image"):
        open_tum(tum)
    (tum / "depth.txt").write_text("1.0\n")
    with pytest.raises(InvalidInputError, match=r"depth\.txt, line 1: expected a time"):
        open_tum(tum)
    (tum / "depth.txt").unlink()
    assert not is_tum_recording(tum)


@pytest.mark.parametrize("content", [b"nan rgb/a.png", b"inf rgb/a.png", b"\xff\xfe"])
def test_unusable_lists_are_refused(tum, content):
    (tum / "rgb.txt").write_bytes(content)
    with pytest.raises(InvalidInputError, match=r"rgb\.txt(, line 1: expected a time| cannot be read)"):
        open_tum(tum)


@pytest.mark.parametrize("seed", range(20))
def test_the_nearest_time_is_the_first_with_the_least_difference(seed):
    rng = np.random.default_rng(seed)
    times = np.sort(rng.integers(0, 8, rng.integers(1, 12)) / 2)
    for time in np.arange(-1, 6, 0.25):
        assert _nearest(times, time) == np.abs(times - time).argmin()


def test_lists_of_too_many_images_are_refused(tum, monkeypatch):
    monkeypatch.setattr("perception.io.recordings.tum.MAX_SEQUENCE", 3)
    assert open_tum(tum).pairs
    with (tum / "depth.txt").open("a") as list_:
        list_.write("7 depth/7.png\n")
    with pytest.raises(InvalidInputError, match=r"depth\.txt lists 4 images, at most 3 are read"):
        open_tum(tum)
