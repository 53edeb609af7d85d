from hashlib import sha256

import pytest

from app import doctor


def test_versions_are_compared_with_the_lock(tmp_path):
    (tmp_path / "lock").write_text("numpy==1.0\nopencv-python-headless==5.0.0.93\n# mink==9\n")
    lock = doctor.locked_versions(tmp_path / "lock")
    assert lock == {"numpy": "1.0", "opencv-python-headless": "5.0.0.93"}
    finding = doctor.check_version("numpy", lock, "missing", "make setup")
    assert finding.status == "ok" and finding.found.endswith("(tested with 1.0)")
    absent = doctor.check_version("no-such-thing", lock, "missing", "make setup")
    assert (absent.status, absent.remedy) == ("missing", "make setup")


def test_the_lock_of_this_repository_is_read():
    assert "mujoco" in doctor.locked_versions()


@pytest.mark.parametrize(
    ("sums", "status", "found"),
    [
        (f"{sha256(b'numbers').hexdigest()}  yaw.safetensors", "ok", sha256(b"numbers").hexdigest()[:12]),
        (f"{sha256(b'other').hexdigest()}  yaw.safetensors", "missing", "checksum differs from SHA256SUMS"),
        (f"{sha256(b'numbers').hexdigest()}  shape.safetensors", "missing", "lists no checksum for yaw"),
        (None, "ok", "no SHA256SUMS beside it"),
    ],
)
def test_weights_are_compared_with_the_checksums_beside_them(tmp_path, sums, status, found):
    (tmp_path / "yaw.safetensors").write_bytes(b"numbers")
    if sums is not None:
        (tmp_path / "SHA256SUMS").write_text(sums)
    finding = doctor.check_weights("yaw", tmp_path)
    assert finding.status == status and found in finding.found
    assert status == "ok" or "nodeslam train yaw" in finding.remedy


@pytest.mark.parametrize("name", doctor.WEIGHTS)
def test_the_shipped_weights_pass(name):
    assert doctor.check_weights(name).status == "ok"


def test_all_shipped_networks_are_checked():
    shipped = {path.stem for path in doctor.WEIGHTS_DIRECTORY.glob("*.safetensors")}
    assert shipped == doctor.WEIGHTS.keys()


def test_missing_weights_say_how_to_get_them(tmp_path):
    finding = doctor.check_weights("shape", tmp_path)
    assert finding.status == "missing" and "nodeslam train shape" in finding.remedy


@pytest.mark.parametrize(
    ("program", "status", "found"),
    [
        ("print('osmesa')", "ok", "MUJOCO_GL=osmesa"),
        ("import os; os.abort()", "missing", "exit code -6"),  # what a wrong OpenGL does to its process
        ("raise SystemExit('no display')", "missing", "no display"),
    ],
)
def test_the_rendering_probe_survives_what_it_probes(program, status, found):
    finding = doctor.check_gl(program)
    assert finding.status == status and finding.found == found
    assert finding.status == "ok" or "apt-get install" in finding.remedy
