"""Meshes and uncertainty colours."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from app.viewer import meshes as module
from app.viewer.meshes import MAX_DEVIATION, UNCERTAINTY_COLORS, MeshCache, deviation_colors
from app.viewer.snapshot import ObjectState
from perception.errors import PerceptionError


@pytest.fixture
def state(recording):
    estimate = recording.objects[0]
    return ObjectState(0, "can", None, estimate.T_world_object, estimate.scale, np.arange(16.0))


def test_colours_run_from_certain_to_uncertain_and_saturate():
    deviation = MAX_DEVIATION * np.array([0, 1 / 3, 2 / 3, 1, 5, 1 / 6])
    expected = [*UNCERTAINTY_COLORS, UNCERTAINTY_COLORS[-1]]
    colors = deviation_colors(deviation)
    np.testing.assert_allclose(colors[:5], expected, atol=1)
    np.testing.assert_allclose(colors[5], np.mean(UNCERTAINTY_COLORS[:2], axis=0), atol=1)
    assert UNCERTAINTY_COLORS[0][2] > UNCERTAINTY_COLORS[0][0]  # certain is blue
    assert UNCERTAINTY_COLORS[-1][0] > UNCERTAINTY_COLORS[-1][2]  # uncertain is red


def test_objects_of_the_map_have_its_mesh_and_fits_are_decoded_once(recording, state, monkeypatch):
    cache, decoded = MeshCache(recording), []
    monkeypatch.setattr(
        module, "mesh_from_code", lambda _, *shape: decoded.append(shape) or recording.objects[0].mesh
    )
    monkeypatch.setattr(MeshCache, "_decoder", None)
    assert cache.mesh(state) is recording.objects[0].mesh and not decoded
    for iteration in (8, 8, 30):
        cache.mesh(replace(state, iteration=iteration))
    assert len(decoded) == 2 and decoded[0][0] == "can" and decoded[0][1] is state.code
    cache.mesh(replace(state, id=5))  # not in the object map
    assert len(decoded) == 3


def test_a_code_without_a_surface_has_no_mesh(recording, state, monkeypatch):
    def fail(*_):
        raise PerceptionError("empty")

    monkeypatch.setattr(module, "mesh_from_code", fail)
    monkeypatch.setattr(MeshCache, "_decoder", None)
    assert MeshCache(recording).mesh(replace(state, iteration=0)) is None


def test_the_recorded_covariance_is_symmetric(recording, state, monkeypatch):
    triangle = np.arange(325.0)
    recording.notes[:] = [note for note in recording.notes if note.kind != "objects"]
    recording.note("objects", covariances={"0": triangle.tolist()})
    used = []
    decoder = SimpleNamespace(with_jacobian=lambda *_: (None, None))
    monkeypatch.setattr(MeshCache, "_decoder", decoder)
    monkeypatch.setattr(
        module, "surface_deviation", lambda _, covariance, *__: used.append(covariance) or np.zeros(2)
    )
    cache = MeshCache(recording)
    np.testing.assert_array_equal(cache.uncertainty_colors(state), [UNCERTAINTY_COLORS[0]] * 2)
    np.testing.assert_array_equal(used[0][np.triu_indices(25)], triangle)
    np.testing.assert_array_equal(used[0], used[0].T)
    own = np.eye(25)
    recording.objects = (replace(recording.objects[0], covariance=own),)
    MeshCache(recording).uncertainty_colors(state)
    np.testing.assert_array_equal(used[1], own)


def test_uncertainty_is_unknown_during_the_fit_and_without_a_covariance(recording, state):
    cache = MeshCache(recording)
    assert cache.uncertainty_colors(replace(state, iteration=8)) is None
    assert cache.uncertainty_colors(replace(state, id=5)) is None
    recording.notes[:] = [note for note in recording.notes if note.kind != "objects"]
    assert MeshCache(recording).uncertainty_colors(state) is None
