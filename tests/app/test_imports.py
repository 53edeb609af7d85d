"""Garbage collection around imports."""

import gc

import pytest

from app.imports import without_collection


@pytest.fixture(autouse=True)
def thawed():
    """Leave the collector as it was."""
    yield
    gc.unfreeze()
    gc.enable()


def test_nothing_is_collected_until_the_modules_are_imported():
    with without_collection():
        assert not gc.isenabled()
        kept = [[] for _ in range(10)]
    assert gc.isenabled() and gc.get_freeze_count() > len(kept)


def test_collection_resumes_after_a_failed_import():
    with pytest.raises(ImportError), without_collection():
        raise ImportError
    assert gc.isenabled()


def test_a_collector_that_is_disabled_stays_so():
    gc.disable()
    with without_collection():
        pass
    assert not gc.isenabled()
