"""NumPy archives: round trip, pickles, archives that unpack to more than they announce, random damage."""

import io
import os
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perception.errors import InvalidInputError
from perception.io.arrays import numbers_of, parse_array, read_arrays
from tests.fuzzing import SHORT, damaged_bytes

ARRAYS = {"a": np.arange(6.0).reshape(2, 3), "text": np.array(["x", "yz"]), "f": np.asfortranarray(np.eye(2))}


def archive(**arrays):
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def test_round_trip(tmp_path):
    (tmp_path / "a.npz").write_bytes(archive(**ARRAYS))
    found = read_arrays(tmp_path / "a.npz")
    assert set(found) == set(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype and found[name].flags.writeable


def test_objects_are_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(archive(a=np.array([{}], dtype=object)))
    with pytest.raises(ValueError, match="holds Python objects"):
        read_arrays(tmp_path / "a.npz")


def test_sizes_are_bounded_before_anything_is_unpacked(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(archive(a=np.zeros(100_000)))
    assert path.stat().st_size < 2000
    with pytest.raises(ValueError, match="its arrays are larger than 2000 bytes"):
        read_arrays(path, max_bytes=2000)
    with pytest.raises(InvalidInputError, match="is too large"):
        read_arrays(path, max_bytes=100)
    os.mkfifo(tmp_path / "b.npz")
    with pytest.raises(InvalidInputError, match="is a named pipe"):
        read_arrays(tmp_path / "b.npz")


def test_a_header_that_announces_too_much_allocates_nothing(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("a.npy", header.getvalue() + bytes(8))
    with pytest.raises(ValueError, match=r"a\.npy announces another size"):
        read_arrays(tmp_path / "a.npz")


@SHORT
@given(data=st.data())
def test_random_damage_is_read_or_refused(tmp_path, data):
    path = tmp_path / "a.npz"
    path.write_bytes(data.draw(damaged_bytes(archive(**ARRAYS))))
    try:
        found = read_arrays(path)
    except (ValueError, OSError):
        return
    assert all(isinstance(array, np.ndarray) for array in found.values())


@pytest.mark.parametrize("value", [True, [1, True], "1", ["1"], None, [[1], [2, 3]], [[1, 2], 3], {"a": 1}])
def test_values_that_are_no_numbers_are_refused(value):
    with pytest.raises(ValueError):
        numbers_of(value)


def test_numbers_of_nested_lists():
    np.testing.assert_array_equal(numbers_of([[1, 2.5], [3, 4]]), [[1, 2.5], [3, 4]])
    assert numbers_of(3).shape == () and numbers_of([]).shape == (0,)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"\x93NUMPY\x01\x00\xff\xff{"])
def test_other_files_are_no_arrays(content):
    with pytest.raises(ValueError):
        parse_array(content, "it")
