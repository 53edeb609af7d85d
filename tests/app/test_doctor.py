import sys
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


def weights(tmp_path, card):
    path = tmp_path / doctor.WEIGHTS["yaw"][0]
    path.parent.mkdir(parents=True)
    path.write_bytes(b"numbers")
    path.with_suffix(".md").write_text(card)


@pytest.mark.parametrize(
    ("card", "status"),
    [
        (f"SHA-256 `{sha256(b'numbers').hexdigest()}`", "ok"),
        (f"SHA-256 `{sha256(b'other numbers').hexdigest()}`", "missing"),
        (f"`{sha256(b'another network').hexdigest()}`, `{sha256(b'numbers').hexdigest()}`", "ok"),
        ("no checksum", "ok"),
    ],
)
def test_weights_are_checked_against_their_card(tmp_path, card, status):
    weights(tmp_path, card)
    assert doctor.check_weights("yaw", tmp_path).status == status


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
    finding = doctor.check_gl(lambda: [sys.executable, "-c", program])
    assert finding.status == status and finding.found == found
    assert finding.status == "ok" or "apt-get install" in finding.remedy
