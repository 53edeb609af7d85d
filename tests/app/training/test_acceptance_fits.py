"""Labels of masks, and chunks that are finished or lost."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from app.training import acceptance_fits
from app.training.acceptance_fits import Chunk, _label, collect
from app.workers import Lost
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


def test_finished_chunks_are_reused_and_lost_ones_reported(tmp_path, monkeypatch):
    done = Chunk(tmp_path, "train", 3, 0, acceptance_fits.CHUNK)
    done.path.write_text(json.dumps([{"first": 1}]))
    asked = []

    def in_processes(function, chunks, workers):
        for chunk in chunks:
            asked.append((chunk.number, chunk.count))
            chunk.path.write_text(json.dumps([{"second": 2}]))
            yield chunk, None

    monkeypatch.setattr(acceptance_fits, "map_in_processes", in_processes)
    assert collect(tmp_path, "train", acceptance_fits.CHUNK + 5, 3) == [{"first": 1}, {"second": 2}]
    assert asked == [(1, 5)]
    monkeypatch.setattr(
        acceptance_fits, "map_in_processes", lambda f, chunks, w: ((c, Lost("killed", 1.0)) for c in chunks)
    )
    with pytest.raises(PerceptionError, match="chunk 0 of test scenes failed: killed"):
        collect(tmp_path, "test", 5, 3)
