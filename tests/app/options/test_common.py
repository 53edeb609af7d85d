"""Which options differ from their defaults."""

from app.options import ScanOptions


def test_changed_options_differ_from_their_defaults():
    assert ScanOptions().changed() == set()
    assert ScanOptions(seed=3, objects="2", gap=0.0, quiet=False).changed() == {"seed", "objects", "gap"}


def test_by_default_all_options_have_an_effect():
    assert ScanOptions(seed=3).without_effect() == {}
