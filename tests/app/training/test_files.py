"""Files of training jobs: arrays, checksums, curves."""

import hashlib
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from app.training.files import checksums, load_arrays, packed_arrays, summary_writer
from perception.errors import PerceptionError


def test_arrays_survive_the_file(tmp_path):
    path = tmp_path / "data.npz"
    holder = SimpleNamespace(a=np.arange(3), b=np.eye(2), c=np.zeros(1))
    path.write_bytes(packed_arrays(holder, ("a", "b")))
    arrays = load_arrays(path, ("a", "b"), "numbers")
    np.testing.assert_array_equal(arrays["a"], [0, 1, 2])
    np.testing.assert_array_equal(arrays["b"], np.eye(2))
    with np.load(path) as stored:
        assert set(stored) == {"a", "b"}


@pytest.mark.parametrize("content", [None, b"", b"no archive"])
def test_unusable_files_are_named(tmp_path, content):
    path = tmp_path / "data.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(PerceptionError, match=r"data\.npz holds no crops .*delete it and train again"):
        load_arrays(path, ("a",), "crops")


def test_missing_arrays_are_named(tmp_path):
    (tmp_path / "data.npz").write_bytes(packed_arrays(SimpleNamespace(a=np.arange(3)), ("a",)))
    with pytest.raises(PerceptionError, match="holds no crops"):
        load_arrays(tmp_path / "data.npz", ("b",), "crops")


def test_cards_end_with_the_digest_of_every_file(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).write_bytes(name.encode())
    a, b = (hashlib.sha256(name).hexdigest() for name in (b"a", b"b"))
    assert checksums(tmp_path / "a", tmp_path / "b") == f"\nSHA-256 of `a` `{a}`, SHA-256 of `b` `{b}`\n"


def test_missing_tensorboard_has_a_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(PerceptionError, match=r"pip install '\.\[train\]'"):
        summary_writer(tmp_path)
