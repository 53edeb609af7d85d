"""Weights files are compared with the checksums beside them whenever they are loaded."""

import os
import re
import shutil
from hashlib import sha256

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import save_file

from perception.detection.crop_network import load_crop_network
from perception.detection.scene_network import load_scene_network
from perception.errors import PerceptionError
from perception.inference.acceptance import LINEAR
from perception.inference.verifier import Verifier
from perception.io.weights import (
    CHECKSUMS_FILE,
    WEIGHTS_DIRECTORY,
    check_shapes,
    expected_checksum,
    load_tensors,
    read_weights,
    verify_weights,
    weights_checksum,
    write_checkpoint,
    write_weights,
)
from perception.shape.weights import load_weights as load_shape
from tests.fuzzing import SHORT, damaged_bytes

SHIPPED = sorted(WEIGHTS_DIRECTORY.glob("*.safetensors"))
COEFFICIENTS = WEIGHTS_DIRECTORY / "acceptance.json"
LOADERS = {
    "shape": load_shape,
    "detector": lambda path: load_crop_network("class", path),
    "pose": lambda path: load_crop_network("pose", path),
    "yaw": lambda path: load_crop_network("yaw", path),
    "axis": lambda path: load_crop_network("axis", path),
    "scene": load_scene_network,
    "verifier": lambda path: Verifier.load(len(LINEAR), path),
}


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "net.safetensors"
    path.write_bytes(b"numbers")
    return path


def list_checksum(path, content=b"numbers", form="{digest}  {name}\n"):
    sums = form.format(digest=sha256(content).hexdigest(), name=path.name)
    (path.parent / CHECKSUMS_FILE).write_text(f"{'0' * 64}  another.safetensors\n{sums}")


def test_checksum_of_a_known_message(tmp_path):
    (tmp_path / "abc").write_bytes(b"abc")  # FIPS 180-4, example B.1
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert weights_checksum(tmp_path / "abc") == known


def test_weights_in_a_folder_without_checksums_are_accepted(weights):
    assert expected_checksum(weights) is None
    verify_weights(weights, "retrain")


@pytest.mark.parametrize("form", ["{digest}  {name}\n", "{digest} *{name}\n", "{digest}  {name}\r\n"])
def test_weights_that_match_are_accepted(weights, form):
    list_checksum(weights, form=form)
    verify_weights(weights, "retrain")


def test_weights_that_differ_are_refused(weights):
    list_checksum(weights, b"Numbers")
    with pytest.raises(PerceptionError, match=r"net\.safetensors differ from .*SHA256SUMS; retrain$"):
        verify_weights(weights, "retrain")


def test_weights_that_are_not_listed_are_refused(weights):
    (weights.parent / CHECKSUMS_FILE).write_text(f"{sha256(b'numbers').hexdigest()}  net.safetensors.old\n")
    with pytest.raises(PerceptionError, match=r"no checksum for net\.safetensors; .*`sha256sum net\.safe"):
        verify_weights(weights, "retrain")


def test_the_shipped_folder_must_have_checksums(weights, monkeypatch):
    monkeypatch.setattr("perception.io.weights.WEIGHTS_DIRECTORY", weights.parent)
    with pytest.raises(PerceptionError, match="SHA256SUMS is missing; restore it"):
        verify_weights(weights, "retrain")


def test_missing_weights_are_named(weights):
    list_checksum(weights)
    weights.unlink()
    with pytest.raises(PerceptionError, match=r"net\.safetensors cannot be read .*; retrain$"):
        verify_weights(weights, "retrain")


def test_every_shipped_file_has_a_checksum_and_matches_it():
    assert [path.stem for path in SHIPPED] == sorted(LOADERS)
    for path in (*SHIPPED, COEFFICIENTS):
        assert expected_checksum(path) == weights_checksum(path)


def test_model_cards_state_the_same_checksums():
    cards = "\n".join(card.read_text() for card in WEIGHTS_DIRECTORY.glob("*.md"))
    stated = re.findall(r"`([0-9a-f]{64})`", cards)
    assert sorted(stated) == sorted(weights_checksum(path) for path in (*SHIPPED, COEFFICIENTS))


@pytest.mark.parametrize("name", LOADERS)
def test_one_flipped_bit_of_the_numbers_is_noticed_on_load(tmp_path, name):
    path = tmp_path / f"{name}.safetensors"
    content = bytearray((WEIGHTS_DIRECTORY / path.name).read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    LOADERS[name](path)  # without checksums nothing is wrong with it
    shutil.copy(WEIGHTS_DIRECTORY / CHECKSUMS_FILE, tmp_path)
    with pytest.raises(PerceptionError, match=rf"{name}\.safetensors differ from their checksum"):
        LOADERS[name](path)


def test_a_pipe_in_place_of_weights_is_refused(tmp_path):
    os.mkfifo(tmp_path / "a.safetensors")
    with pytest.raises(PerceptionError, match="is a named pipe, not a regular file"):
        weights_checksum(tmp_path / "a.safetensors")


@SHORT
@given(
    about=st.dictionaries(st.text(max_size=8), st.text(max_size=8), max_size=6),
    shape=st.lists(st.integers(0, 3), max_size=3),
)
def test_written_weights_are_read_back_and_equal_ones_have_one_digest(tmp_path, about, shape):
    sent = {"b": np.arange(3), "a": np.random.default_rng(0).random(shape).astype(np.float16)}
    path = tmp_path / "new" / "a.safetensors"
    digests = set()
    for entries in (about, dict(reversed(about.items()))):
        write_weights(path, sent, entries)
        digests.add(weights_checksum(path))
    tensors, metadata = read_weights(path, "train again")
    assert len(digests) == 1 and metadata == about
    assert all(np.array_equal(tensors[name], sent[name]) for name in sent)
    assert all(tensors[name].dtype == sent[name].dtype for name in sent)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_checkpoints_leave_no_temporary_file(tmp_path):
    write_checkpoint(tmp_path / "new" / "checkpoint.pt", {"done": 3, "weight": torch.eye(2)})
    state = torch.load(tmp_path / "new" / "checkpoint.pt", weights_only=True)
    assert state["done"] == 3 and torch.equal(state["weight"], torch.eye(2))
    assert len(list((tmp_path / "new").iterdir())) == 1


def saved(path, tensors):
    save_file(tensors, path, metadata={"task": "class"})
    return path


def test_tensors_and_metadata_are_read(tmp_path):
    sent = {"weight": torch.eye(2), "count": torch.arange(3)}
    tensors, metadata = read_weights(saved(tmp_path / "a.safetensors", sent), "train again")
    assert metadata == {"task": "class"} and tensors.keys() == sent.keys()
    assert all(np.array_equal(tensors[name], sent[name].numpy()) for name in sent)


def test_numbers_that_are_not_finite_are_refused(tmp_path):
    path = saved(tmp_path / "a.safetensors", {"w": torch.tensor([1.0, torch.nan])})
    with pytest.raises(
        PerceptionError, match=r"a\.safetensors: 'w' holds numbers .* not finite; train again"
    ):
        read_weights(path, "train again")


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (torch.complex64, "C64"),
        (torch.float8_e4m3fn, "F8_E4M3"),
        (torch.bool, "BOOL"),
        (torch.bfloat16, "BF16"),
    ],
)
def test_numbers_of_other_types_are_refused(tmp_path, kind, name):
    path = saved(tmp_path / "a.safetensors", {"w": torch.ones(2).to(kind)})
    with pytest.raises(PerceptionError, match=rf"'w' holds {name} numbers; train again"):
        read_weights(path, "train again")


def test_checksums_that_are_no_text_are_refused(weights):
    (weights.parent / CHECKSUMS_FILE).write_bytes(b"\xff\xfe")
    with pytest.raises(PerceptionError, match=r"net\.safetensors cannot be read .*; retrain$"):
        verify_weights(weights, "retrain")


def test_a_difference_to_the_network_is_named(tmp_path):
    with pytest.raises(PerceptionError, match=r"do not fit the network \(size mismatch for weight.*train"):
        load_tensors(torch.nn.Linear(3, 1, bias=False), {"weight": np.eye(2)}, tmp_path / "a", "train")


@pytest.mark.parametrize(
    ("expected", "message"),
    [
        ({"w": (2, 3)}, r"'w' is \(2, 2\), expected \(2, 3\)"),
        ({"w": (2, 2), "b": (2,)}, r"'b' is missing, expected \(2,\)"),
        ({}, r"'w' is \(2, 2\), expected nothing"),
    ],
)
def test_parameters_of_another_network_are_named(tmp_path, expected, message):
    with pytest.raises(PerceptionError, match=rf"a do not fit the network \({message}\); train"):
        check_shapes({"w": np.eye(2)}, expected, tmp_path / "a", "train")
    check_shapes({"w": np.eye(2)}, {"w": (2, 2)}, tmp_path / "a", "train")


def test_pipes_are_no_weights(tmp_path):
    os.mkfifo(tmp_path / "a.safetensors")
    with pytest.raises(PerceptionError, match="are missing; train again"):
        read_weights(tmp_path / "a.safetensors", "train again")


@SHORT
@given(data=st.data())
def test_random_damage_is_read_or_refused(tmp_path, data):
    path = tmp_path / "a.safetensors"
    content = saved(path, {"w": torch.eye(3)}).read_bytes()
    path.write_bytes(data.draw(damaged_bytes(content)))
    try:
        tensors, _ = read_weights(path, "train again")
    except PerceptionError:
        return
    assert all(np.isfinite(tensor).all() for tensor in tensors.values())
