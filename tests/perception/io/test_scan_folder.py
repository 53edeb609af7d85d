"""Scan folders: round trip, BOP conventions, damaged images and files."""

import json
import math
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from perception.errors import InvalidInputError
from perception.io import scan_folder
from perception.io.images import png_bytes
from perception.io.scan_folder import ScanIndex, read_scan, write_scan
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame
from tests.fuzzing import SHORT, damaged_bytes, damaged_json

H, W = 24, 32
CAMERA = CameraIntrinsics(width=W, height=H, fx=30.0, fy=31.0, cx=15.5, cy=11.5)


def pose(angle=0.3):
    T = np.eye(4)
    T[:3, :3] = [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    T[:3, 3] = (0.4, -0.2, 0.5)
    return T


def frame(index=0, **changes):
    rng = np.random.default_rng(index)
    depth = rng.uniform(0.3, 2.0, (H, W)).astype(np.float32)
    depth[0, 0], depth[0, 1] = 0.0, 9.0  # no measurement; farther than the format holds
    fields = {
        "time": 0.5 * index,
        "rgb": rng.integers(0, 255, (H, W, 3), dtype=np.uint8),
        "depth": depth,
        "intrinsics": CAMERA,
        "T_world_camera": pose(index),
    }
    return RgbdFrame(**(fields | changes))


def detection(**changes):
    mask = np.zeros((H, W), bool)
    mask[3:9, 5:20] = True
    mask[5, 7] = False
    fields = {"category": "mug", "score": 0.9, "mask": mask, "instance_id": 4}
    return ObjectDetection(**(fields | changes))


@pytest.fixture
def folder(tmp_path):
    found = detection(yaw_probabilities=np.full(4, 0.25))
    write_scan(tmp_path / "scan", [frame(i) for i in range(3)], [[found], [], [detection(instance_id=None)]])
    return tmp_path / "scan"


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_round_trip_keeps_images_poses_and_detections(folder):
    scan = read_scan(folder)
    assert scan.image_ids == (0, 1, 2) and scan.warnings == () and scan.has_poses
    for index, got in enumerate(scan.frames):
        sent = frame(index)
        np.testing.assert_array_equal(got.rgb, sent.rgb)
        measured = sent.depth < 6.5
        np.testing.assert_allclose(got.depth[measured], sent.depth[measured], atol=0.51e-4)
        assert not got.depth[~measured].any()
        np.testing.assert_allclose(got.T_world_camera, sent.T_world_camera, atol=1e-9)
        assert (got.time, got.intrinsics) == (sent.time, CAMERA)
    first, none, last = scan.detections
    np.testing.assert_array_equal(first[0].mask, detection().mask)
    assert (first[0].category, first[0].score, first[0].instance_id) == ("mug", 0.9, 4)
    np.testing.assert_allclose(first[0].yaw_probabilities, 0.25)
    assert none == () and last[0].instance_id is None


def test_poses_and_detections_may_be_absent(tmp_path):
    write_scan(tmp_path, [frame(T_world_camera=None), frame(1, T_world_camera=None)])
    scan = read_scan(tmp_path)
    assert not scan.has_poses and scan.detections is None


def test_poses_are_written_as_bop_says(folder):
    camera = json.loads((folder / "scene_camera.json").read_text())["0"]
    R, t = np.reshape(camera["cam_R_w2c"], (3, 3)), np.array(camera["cam_t_w2c"])
    T_world_camera = pose(0)
    point_camera = np.array([0.1, 0.2, 0.7])
    point_world = T_world_camera[:3, :3] @ point_camera + T_world_camera[:3, 3]
    np.testing.assert_allclose(R @ (1000 * point_world) + t, 1000 * point_camera, atol=1e-9)


def test_one_broken_image_of_several_is_left_out_and_named(folder):
    path = folder / "rgb" / "000001.png"
    path.write_bytes(path.read_bytes()[:200])
    scan = read_scan(folder)
    assert scan.image_ids == (0, 2) and len(scan.detections) == 2
    assert len(scan.warnings) == 1 and "rgb/000001.png is not a readable PNG" in scan.warnings[0]


def save(path, array):
    Image.fromarray(array).save(path)


BROKEN_IMAGES = {
    "missing": (lambda f: (f / "depth/000000.png").unlink(), "000000.png is missing"),
    "truncated": (lambda f: (f / "depth/000000.png").write_bytes(b"\x89PNG\r\n"), "not a readable PNG"),
    "text": (lambda f: (f / "rgb/000000.png").write_text("no image"), "not a readable PNG"),
    "depth of 8 bits": (
        lambda f: save(f / "depth/000000.png", np.ones((H, W), np.uint8)),
        "must be 16-bit grey",
    ),
    "depth of another size": (
        lambda f: save(f / "depth/000000.png", np.ones((H, W + 2), np.uint16)),
        "is 34x24 but the colour image is 32x24",
    ),
    "grey colour": (lambda f: save(f / "rgb/000000.png", np.ones((H, W), np.uint8)), "must be 8-bit RGB"),
}


@pytest.mark.parametrize("damage, message", BROKEN_IMAGES.values(), ids=BROKEN_IMAGES)
def test_broken_images(tmp_path, damage, message):
    write_scan(tmp_path, [frame()])
    damage(tmp_path)
    with pytest.raises(InvalidInputError, match=message):
        read_scan(tmp_path)


def test_flipped_bit_in_an_image_is_noticed(tmp_path):
    write_scan(tmp_path, [frame()])
    path = tmp_path / "depth/000000.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(bytes(data))
    with pytest.raises(InvalidInputError, match="not a readable PNG"):
        read_scan(tmp_path)


def test_image_linked_from_outside_is_refused(tmp_path):
    write_scan(tmp_path / "scan", [frame()])
    image = tmp_path / "scan/rgb/000000.png"
    image.rename(tmp_path / "elsewhere.png")
    image.symlink_to(tmp_path / "elsewhere.png")
    with pytest.raises(InvalidInputError, match="leads out of the scan folder"):
        read_scan(tmp_path / "scan")


BAD_CAMERAS = {
    "id is a path": (lambda c: c.update({"../../etc/passwd": c.pop("0")}), "is not a number"),
    "empty": (lambda c: c.clear(), "at least one"),
    "no matrix": (lambda c: c["0"].pop("cam_K"), "cam_K must be 9 finite numbers"),
    "NaN": (lambda c: c["0"].update(cam_K=[float("nan")] * 9), "holds NaN, which is no number in JSON"),
    "one image twice": (lambda c: c.update({"00": c["0"]}), "lists an image twice"),
    "translation alone": (lambda c: c["0"].pop("cam_R_w2c"), "has no pose"),
    "time in nanoseconds": (lambda c: c["0"].update(time=1.7e18), "time must be seconds, got"),
    "words": (lambda c: c["0"].update(cam_K=["a"] * 9), "cam_K must be 9 finite numbers"),
    "skew": (lambda c: c["0"]["cam_K"].__setitem__(1, 3.0), "undistort"),
    "focal length": (lambda c: c["0"]["cam_K"].__setitem__(0, 1e7), "implausible"),
    "negative focal length": (lambda c: c["0"]["cam_K"].__setitem__(0, -30.0), "must be positive"),
    "principal point": (lambda c: c["0"]["cam_K"].__setitem__(2, 1e5), "principal point"),
    "scale zero": (lambda c: c["0"].update(depth_scale=0), "depth_scale 0"),
    "tiny scale": (lambda c: c["0"].update(depth_scale=1e-9), "depth_scale 1e-09 must be in 0.001..1000"),
    "no scale": (lambda c: c["0"].pop("depth_scale"), "depth_scale must be a finite number"),
    "no rotation": (lambda c: c["0"].update(cam_R_w2c=[2, 0, 0, 0, 2, 0, 0, 0, 2]), "not a rotation matrix"),
    "half a pose": (lambda c: c["0"].pop("cam_t_w2c"), "has no pose"),
    "pose of words": (lambda c: c["0"].update(cam_t_w2c="far away"), "cam_t_w2c must be 3 finite numbers"),
    "quoted numbers": (lambda c: c["0"].update(cam_K=["1"] * 9), "cam_K must be 9 finite numbers"),
    "truth values": (lambda c: c["0"].update(cam_K=[True] * 9), "cam_K must be 9 finite numbers"),
    "time is true": (lambda c: c["0"].update(time=True), "time must be seconds, got True"),
    "too many": (lambda c: c.update({str(key): {} for key in range(1, 2002)}), "at most 2000 are read"),
    "not a camera": (lambda c: c.update({"0": 7}), "cam_K must be 9 finite numbers"),
}


@pytest.mark.parametrize("damage, message", BAD_CAMERAS.values(), ids=BAD_CAMERAS)
def test_bad_cameras(tmp_path, damage, message):
    write_scan(tmp_path, [frame()])
    edit(tmp_path / "scene_camera.json", damage)
    with pytest.raises(InvalidInputError, match=message) as caught:
        read_scan(tmp_path)
    assert "scene_camera.json" in str(caught.value) and "\n" not in str(caught.value)


def test_a_frame_without_pose_among_posed_ones_is_left_out(folder):
    edit(folder / "scene_camera.json", lambda c: [c["2"].pop(k) for k in ("cam_R_w2c", "cam_t_w2c")])
    scan = read_scan(folder)
    assert scan.image_ids == (0, 1) and "image 2: has no pose" in scan.warnings[0]


@pytest.mark.parametrize("name", ["scene_camera.json", "detections.json"])
def test_json_cut_short_is_named(folder, name):
    path = folder / name
    path.write_text(path.read_text()[:60])
    with pytest.raises(InvalidInputError, match=f"{name} is not valid JSON"):
        read_scan(folder)


def test_no_folder_and_no_cameras(tmp_path):
    with pytest.raises(InvalidInputError, match="is not a folder"):
        read_scan(tmp_path / "nowhere")
    with pytest.raises(InvalidInputError, match=r"scene_camera\.json is missing"):
        read_scan(tmp_path)
    (tmp_path / "scan").mkdir()
    (tmp_path / "scan" / "scene_camera.json").write_text("{}")
    with pytest.raises(InvalidInputError, match=f"the scan folder is {tmp_path / 'scan'}"):
        read_scan(tmp_path)


# --- masks, JPEG colour, conventions of other tools ---------------------------------------------


def blob(left):
    mask = np.zeros((H, W), np.uint8)
    mask[10:20, left : left + 8] = 255
    return mask


def write_png(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png_bytes(image))


@pytest.fixture
def bop(tmp_path):
    """Two images without poses, the first with two masks."""
    write_scan(tmp_path / "bop", [frame(i, T_world_camera=None) for i in (0, 1)])
    write_png(tmp_path / "bop/mask/000000_000000.png", np.full((H, W), 255, np.uint8))
    for number, left in enumerate((2, 20)):
        write_png(tmp_path / f"bop/mask_visib/000000_{number:06d}.png", blob(left))
    return tmp_path / "bop"


def test_visible_masks_are_preferred(bop):
    scan = read_scan(bop)
    assert scan.detections is None and scan.masks is not None and not scan.has_poses
    assert [len(masks) for masks in scan.masks] == [2, 0]
    np.testing.assert_array_equal(scan.masks[0][1], blob(20) > 0)


def test_without_mask_folders_there_are_no_masks(tmp_path):
    write_scan(tmp_path / "scan", [frame()])
    assert read_scan(tmp_path / "scan").masks is None


def test_masks_of_another_size_or_name_are_named(bop):
    write_png(bop / "mask_visib/000001_000000.png", np.full((H, W + 2), 255, np.uint8))
    with pytest.raises(InvalidInputError, match=r"000001_000000.png is 34x24 but its image is 32x24"):
        read_scan(bop)
    (bop / "mask_visib/000001_000000.png").rename(bop / "mask_visib/cup.png")
    with pytest.raises(InvalidInputError, match=r"masks are named <image>_<number>\.png"):
        read_scan(bop)


def test_jpeg_colour_is_read_and_a_broken_one_named(tmp_path):
    write_scan(tmp_path / "scan", [frame(rgb=np.full((H, W, 3), 90, np.uint8))])
    (tmp_path / "scan/rgb/000000.png").unlink()
    Image.fromarray(np.full((H, W, 3), 90, np.uint8)).save(tmp_path / "scan/rgb/000000.jpg", quality=95)
    read = read_scan(tmp_path / "scan").frames[0]
    assert np.abs(read.rgb.astype(int) - 90).max() <= 2
    (tmp_path / "scan/rgb/000000.jpg").write_bytes(b"\xff\xd8 no picture")
    with pytest.raises(InvalidInputError, match=r"000000\.jpg is not a readable JPEG"):
        read_scan(tmp_path / "scan")


@pytest.mark.parametrize("scale", [1.0, 0.1, 2.0])
def test_depth_scale_is_millimetres_per_unit(tmp_path, scale):
    write_scan(tmp_path, [frame()])
    save(tmp_path / "depth/000000.png", np.full((H, W), 850, np.uint16))
    edit(tmp_path / "scene_camera.json", lambda c: c["0"].update(depth_scale=scale))
    np.testing.assert_allclose(read_scan(tmp_path).frames[0].depth, 0.85 * scale, rtol=1e-6)


def test_images_without_times_are_33_ms_apart(tmp_path):
    write_scan(tmp_path, [frame(i) for i in range(3)])
    edit(tmp_path / "scene_camera.json", lambda c: [entry.pop("time") for entry in c.values()])
    np.testing.assert_allclose([f.time for f in read_scan(tmp_path).frames], [0, 1 / 30, 2 / 30])


def test_world_to_camera_poses_of_other_tools_are_inverted(tmp_path):
    write_scan(tmp_path, [frame()])
    quarter_turn = [0, -1, 0, 1, 0, 0, 0, 0, 1]
    edit(
        tmp_path / "scene_camera.json",
        lambda c: c["0"].update(cam_R_w2c=quarter_turn, cam_t_w2c=[100, 200, 300]),
    )
    T = read_scan(tmp_path).frames[0].T_world_camera
    np.testing.assert_allclose(T[:3, :3], np.reshape(quarter_turn, (3, 3)).T, atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], (-0.2, 0.1, -0.3), atol=1e-12)


@pytest.mark.parametrize(("z", "accepted"), [(99.9, True), (100.1, False), (1e6, False)])
def test_cameras_beyond_the_scene_are_refused(tmp_path, z, accepted):
    write_scan(tmp_path, [frame()])
    edit(
        tmp_path / "scene_camera.json",
        lambda c: c["0"].update(cam_R_w2c=[1, 0, 0, 0, 1, 0, 0, 0, 1], cam_t_w2c=[0, 0, -1000 * z]),
    )
    if accepted:
        np.testing.assert_allclose(read_scan(tmp_path).frames[0].T_world_camera[2, 3], z)
    else:
        with pytest.raises(InvalidInputError, match=r"m from the origin, .*: check the unit"):
            read_scan(tmp_path)
        with pytest.raises(InvalidInputError, match="image 0: the camera is"):
            ScanIndex.of(tmp_path).read(0)


def test_an_index_reads_single_images_with_their_poses(folder):
    index = ScanIndex.of(folder)
    assert index.ids == [0, 1, 2]
    np.testing.assert_allclose(index.read(2).T_world_camera, pose(2), atol=1e-9)


def test_translations_in_metres_are_reported(folder, caplog):
    def scaled(factor):
        def change(cameras):
            for camera in cameras.values():
                camera["cam_t_w2c"] = [factor * x for x in camera["cam_t_w2c"]]

        return change

    assert read_scan(folder).warnings == ()
    edit(folder / "scene_camera.json", scaled(0.001))
    (warning,) = read_scan(folder).warnings
    assert warning == (
        f"{folder / 'scene_camera.json'}: the translations cam_t_w2c are at most 0.671 mm long, "
        "probably they are in metres: multiply them by 1000"
    )
    assert warning in caplog.text
    edit(folder / "scene_camera.json", scaled(10.1 / 0.6708))  # one of them is 10.1 mm long
    assert read_scan(folder).warnings == ()
    edit(folder / "scene_camera.json", scaled(0.0))  # one camera frame is the world
    assert read_scan(folder).warnings == ()


def test_more_masks_than_the_limit_are_refused(folder, monkeypatch):
    (folder / "detections.json").unlink()
    (folder / "mask").mkdir()
    monkeypatch.setattr(scan_folder, "MAX_PER_IMAGE", 2)
    for number in range(3):
        assert number == 0 or len(read_scan(folder).masks[1]) == number
        (folder / "mask" / f"000001_{number:06d}.png").write_bytes(png_bytes(np.full((H, W), 255, np.uint8)))
    with pytest.raises(InvalidInputError, match="mask: image 1 has more than 2 masks: keep the best ones"):
        read_scan(folder)


def test_a_pipe_in_place_of_an_image_is_skipped(folder):
    (folder / "rgb" / "000001.png").unlink()
    os.mkfifo(folder / "rgb" / "000001.png")
    scan = read_scan(folder)
    assert scan.image_ids == (0, 2) and "000001.png is a named pipe" in scan.warnings[0]


@pytest.mark.parametrize("name", ["²_000000.png", "x.png", "0.png"])
def test_masks_need_the_number_of_an_image(bop, name):
    write_png(bop / "mask_visib" / name, blob(5))
    with pytest.raises(InvalidInputError, match="masks are named"):
        read_scan(bop)


def is_read_or_refused(folder):
    try:
        scan = read_scan(folder)
    except InvalidInputError as error:
        assert str(folder) in str(error)
        return
    for frame in scan.frames:
        assert np.isfinite(frame.depth).all() and np.isfinite(frame.intrinsics.matrix).all()
        assert frame.T_world_camera is None or np.isfinite(frame.T_world_camera).all()


@pytest.mark.parametrize("name", ["scene_camera.json", "detections.json"])
@SHORT
@given(data=st.data())
def test_any_change_of_a_json_file_is_read_or_refused(folder, name, data):
    original = (folder / name).read_text()
    (folder / name).write_text(json.dumps(data.draw(damaged_json(json.loads(original)))))
    is_read_or_refused(folder)
    (folder / name).write_text(original)


@pytest.mark.parametrize(
    "name", ["scene_camera.json", "detections.json", "rgb/000000.png", "depth/000001.png"]
)
@SHORT
@given(data=st.data())
def test_random_damage_of_a_file_is_read_or_refused(folder, name, data):
    original = (folder / name).read_bytes()
    (folder / name).write_bytes(data.draw(damaged_bytes(original)))
    is_read_or_refused(folder)
    (folder / name).write_bytes(original)
