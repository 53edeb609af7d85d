"""Labels of masks, and chunks that are finished or lost."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from app.training import acceptance_fits
from app.training.acceptance_fits import Chunk, _label, collect
from perception.errors import PerceptionError
from perception.types import ObjectDetection


def test_masks_are_attributed_to_the_item_they_show_most():
    instances = np.full((10, 10), -1)
    instances[:, 2:6], instances[:, 6:9] = 0, 1
    labels = (
        SimpleNamespace(category="mug", ignored=False),
        SimpleNamespace(category=None, ignored=False),
    )
    image = SimpleNamespace(instances=instances, labels=labels)

    def label(columns):
        mask = np.zeros((10, 10), bool)
        mask[:, columns] = True
        return _label(image, ObjectDetection("can", 0.5, mask))

    assert label(slice(2, 6)) == "mug" and label(slice(6, 9)) == "other"
    assert label(slice(4, 8)) == "other" and label(slice(8, 10)) == "other"  # half of each; background
    labels[0].ignored = True
    assert label(slice(2, 6)) == "ignored"


def test_finished_chunks_are_reused_and_failed_ones_reported(tmp_path, monkeypatch):
    done = Chunk(tmp_path, "train", 3, 0, acceptance_fits.CHUNK)
    done.path.write_text(json.dumps([{"first": 1}]))
    asked = []

    def fits(chunk):
        asked.append((chunk.number, chunk.count))
        return (json.dumps([{"second": 2}]).encode(),)

    monkeypatch.setattr(acceptance_fits, "collect_chunk", fits)
    assert collect(tmp_path, "train", acceptance_fits.CHUNK + 5, 3) == [{"first": 1}, {"second": 2}]
    assert asked == [(1, 5)]
    monkeypatch.setattr(acceptance_fits, "collect_chunk", lambda chunk: 1 / 0)
    with pytest.raises(PerceptionError, match="reconstructing test scenes: shard 0 crashed: ZeroDivision"):
        collect(tmp_path, "test", 5, 3)
