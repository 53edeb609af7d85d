import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from pycocotools import mask as coco

from perception.errors import InvalidInputError
from perception.io.detections import decode_mask, encode_mask
from perception.io.scan_folder import read_scan, write_scan
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame

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
    "NaN": (lambda c: c["0"].update(cam_K=[float("nan")] * 9), "cam_K must be 9 finite numbers"),
    "words": (lambda c: c["0"].update(cam_K=["a"] * 9), "cam_K must be 9 finite numbers"),
    "skew": (lambda c: c["0"]["cam_K"].__setitem__(1, 3.0), "undistort"),
    "focal length": (lambda c: c["0"]["cam_K"].__setitem__(0, 1e7), "absurd"),
    "negative focal length": (lambda c: c["0"]["cam_K"].__setitem__(0, -30.0), "absurd"),
    "principal point": (lambda c: c["0"]["cam_K"].__setitem__(2, 1e5), "principal point"),
    "scale zero": (lambda c: c["0"].update(depth_scale=0), "depth_scale 0"),
    "no scale": (lambda c: c["0"].pop("depth_scale"), "depth_scale must be a finite number"),
    "no rotation": (lambda c: c["0"].update(cam_R_w2c=[2, 0, 0, 0, 2, 0, 0, 0, 2]), "not a rotation matrix"),
    "half a pose": (lambda c: c["0"].pop("cam_t_w2c"), "has no pose"),
    "pose of words": (lambda c: c["0"].update(cam_t_w2c="far away"), "cam_t_w2c must be 3 finite numbers"),
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


BAD_DETECTIONS = {
    "no list": (lambda d: {"mask": 1}, "must be a list"),
    "unknown class": (
        lambda d: [d[0] | {"category_name": "spoon"}],
        "'spoon' is none of mug, bowl, bottle, can",
    ),
    "no class": (lambda d: [d[0] | {"category_name": ["mug"]}], "is none of"),
    "unknown image": (lambda d: [d[0] | {"image_id": 77}], "image_id 77 is not in scene_camera.json"),
    "image is a list": (lambda d: [d[0] | {"image_id": [0]}], r"image_id \[0\] is not in"),
    "score": (lambda d: [d[0] | {"score": float("nan")}], "score nan must be"),
    "instance": (lambda d: [d[0] | {"instance_id": "first"}], "instance_id 'first' must be"),
    "size": (
        lambda d: [d[0] | {"segmentation": encode_mask(np.ones((4, 4), bool))}],
        r"mask has size \[4, 4\] but the image has \[24, 32\]",
    ),
    "cut short": (lambda d: cut(d, lambda counts: counts[:-2]), "run-length code"),
    "garbage": (lambda d: cut(d, lambda counts: "\u20ac"), "do not decode"),
    "negative runs": (lambda d: cut(d, lambda counts: [-5, H * W + 5]), "damaged"),
    "no mask": (lambda d: [d[0] | {"segmentation": None}], "must be a COCO run-length code"),
    "polygons": (lambda d: [d[0] | {"segmentation": [[0, 0, 4, 4]]}], "must be a COCO run-length code"),
    "empty mask": (lambda d: cut(d, lambda counts: [H * W]), "mask of a mug is empty"),
    "yaw": (lambda d: [d[0] | {"yaw_probabilities": ["north"]}], "yaw_probabilities must be"),
}


def cut(entries, change):
    entries[0]["segmentation"]["counts"] = change(entries[0]["segmentation"]["counts"])
    return entries


@pytest.mark.parametrize("damage, message", BAD_DETECTIONS.values(), ids=BAD_DETECTIONS)
def test_bad_detections(folder, damage, message):
    path = folder / "detections.json"
    path.write_text(json.dumps(damage(json.loads(path.read_text()))))
    with pytest.raises(InvalidInputError, match=message) as caught:
        read_scan(folder)
    assert "detections.json" in str(caught.value) and "delete it" in str(caught.value)


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


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_masks_survive_and_agree_with_pycocotools(height, width, seed, density):
    mask = np.random.default_rng(seed).random((height, width)) < density
    code = encode_mask(mask)
    np.testing.assert_array_equal(decode_mask(json.loads(json.dumps(code)), (height, width)), mask)
    np.testing.assert_array_equal(coco.decode(code), mask)
