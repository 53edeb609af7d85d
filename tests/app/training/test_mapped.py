"""Arrays in files, mapped into memory."""

import pickle
from dataclasses import dataclass

import numpy as np

from app.training.mapped import Mapped, folder_of_arrays


@dataclass(frozen=True)
class Pair:
    numbers: np.ndarray
    nothing: np.ndarray


def test_arrays_are_those_that_were_written_and_changes_stay_in_the_process(tmp_path):
    pair = Pair(np.arange(6, dtype=np.uint8).reshape(2, 3), np.zeros((0, 4), np.float32))
    mapped = pickle.loads(pickle.dumps(Mapped.write(pair, tmp_path / "pair")))  # noqa: S301
    found = mapped.open()
    np.testing.assert_array_equal(found.numbers, pair.numbers)
    assert found.numbers.dtype == np.uint8 and found.nothing.shape == (0, 4)
    assert type(found.numbers) is np.ndarray and isinstance(found.numbers.base, np.memmap)
    found.numbers[0] = 9
    np.testing.assert_array_equal(mapped.open().numbers, pair.numbers)


def test_the_folder_is_removed_and_that_of_a_killed_process_too(tmp_path):
    (tmp_path / "mapped" / "old").mkdir(parents=True)
    with folder_of_arrays(tmp_path) as folder:
        assert not folder.exists()
        Mapped.write(Pair(np.zeros(1), np.zeros(1)), folder / "new")
    assert list(tmp_path.iterdir()) == []
