"""Caches of libraries where the home folder cannot be written."""

import os
from pathlib import Path

from app.caches import use_writable_caches

UNWRITABLE = "/proc/nowhere"


def test_writable_caches_are_left_as_they_are(tmp_path):
    environment = {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    use_writable_caches(environment)
    assert environment == {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


def test_unwritable_caches_are_replaced_by_a_private_temporary_folder(tmp_path):
    environment = {"XDG_CACHE_HOME": UNWRITABLE, "TMPDIR": str(tmp_path)}
    use_writable_caches(environment)
    folder = tmp_path / f"nodeslam-cache-{os.getuid()}"
    assert environment["WARP_CACHE_PATH"] == str(folder / "warp")
    assert environment["MPLCONFIGDIR"] == str(folder / "matplotlib")
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_folder_that_others_can_write_to_is_not_trusted(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    planted = tmp_path / f"nodeslam-cache-{os.getuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    environment = {"XDG_CACHE_HOME": UNWRITABLE, "TMPDIR": str(tmp_path)}
    use_writable_caches(environment)
    chosen = Path(environment["WARP_CACHE_PATH"])
    assert planted not in chosen.parents and chosen.parent.stat().st_mode & 0o777 == 0o700


def test_folders_that_the_user_has_set_are_used(tmp_path):
    environment = {"WARP_CACHE_PATH": str(tmp_path / "w"), "MPLCONFIGDIR": str(tmp_path / "m")}
    use_writable_caches(environment)
    assert environment == {"WARP_CACHE_PATH": str(tmp_path / "w"), "MPLCONFIGDIR": str(tmp_path / "m")}


def test_without_a_home_folder_nothing_is_written_to_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as for a user without an entry
    environment = {"TMPDIR": str(tmp_path / "tmp")}
    (tmp_path / "tmp").mkdir()
    use_writable_caches(environment)
    assert [path.name for path in tmp_path.iterdir()] == ["tmp"]
    assert Path(environment["WARP_CACHE_PATH"]).is_relative_to(tmp_path / "tmp")
