"""Shared arrays: the same memory in another process; entries of a batch and Gymnasium's form of ``info``."""

import multiprocessing

import numpy as np
import pytest

from app.environments.batch import Batch, SharedArray
from app.environments.environment import PackEnv

CONTEXT = multiprocessing.get_context("spawn")


@pytest.fixture(scope="module")
def batch():
    return Batch.of(
        PackEnv(objects="can=1,mug=1", privileged=True, images=True, image_size=(32, 24)), 3, CONTEXT
    )


def double(array):
    array.values *= 2


def test_another_process_writes_into_the_same_memory():
    array = SharedArray(CONTEXT, (2, 3), np.float32)
    assert array.values.shape == (2, 3) and not array.values.any()
    array.values[:] = [[1, 2, 3], [4, 5, 6]]
    process = CONTEXT.Process(target=double, args=(array,))
    process.start()
    process.join()
    np.testing.assert_array_equal(array.values, [[2, 4, 6], [8, 10, 12]])


def test_arrays_without_entries():
    assert SharedArray(CONTEXT, (3, 0), np.bool_).values.shape == (3, 0)


def test_entries_have_the_shapes_and_types_of_the_spaces(batch):
    shapes = {name: (array.values.shape, array.values.dtype) for name, array in batch.observations.items()}
    assert shapes == {
        "state": ((3, 15), np.float32),
        "objects": ((3, 2, 13), np.float32),
        "wrist": ((3, 24, 32, 3), np.uint8),
        "scene": ((3, 24, 32, 3), np.uint8),
    }
    assert batch.actions.values.shape == (3, 8) and batch.actions.values.dtype == np.float32
    assert batch.infos["placed"].values.shape == (3, 2)


def test_what_is_written_is_read_as_copies(batch):
    observation = {name: np.full(array.values.shape[1:], 7) for name, array in batch.observations.items()}
    batch.write(1, observation, {"placed": [True, False], "success": True, "time": 2.5})
    read = batch.read_observations()
    assert all((read[name][1] == 7).all() and not read[name][[0, 2]].any() for name in read)
    batch.observations["state"].values[1] = 8
    assert (read["state"][1] == 7).all()
    batch.write_outcome(2, 0.5, True, False)
    assert batch.rewards.values.tolist() == [0, 0, 0.5]
    assert batch.terminations.values.tolist() == [False, False, True]
    assert not batch.truncations.values.any()


def test_information_that_was_not_written_is_zero(batch):
    observation = {name: array.values[1] for name, array in batch.observations.items()}
    batch.write(1, observation, {"placed": [True, False], "success": True, "time": 2.5})
    infos = batch.read_infos(np.array([True, False, True]))
    assert infos["_time"].tolist() == [True, False, True] and infos["time"].tolist() == [0, 0, 0]
    infos = batch.read_infos(np.array([False, True, False]))
    assert infos["time"].tolist() == [0, 2.5, 0] and infos["placed"].tolist()[1] == [True, False]
