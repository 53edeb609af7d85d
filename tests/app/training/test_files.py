"""Files of the training jobs."""

import sys

import pytest

from app.training.files import summary_writer
from perception.errors import PerceptionError


def test_missing_tensorboard_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(PerceptionError, match=r"pip install '\.\[train\]'"):
        summary_writer(tmp_path)
