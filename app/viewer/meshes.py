"""Meshes and uncertainty colours of objects, cached because decoding a shape is slow."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8

from app.runs.replay import Recorder
from app.viewer.snapshot import ObjectState
from perception.errors import PerceptionError
from perception.inference.meshing import mesh_from_code
from perception.inference.uncertainty import surface_deviation
from perception.shape.decoder import ShapeDecoder
from perception.types import ObjectEstimate, TriangleMesh

MAX_DEVIATION = 0.006  # [m] standard deviation shown in the last colour
# From certain to uncertain: dark blue, teal, yellow, red.
UNCERTAINTY_COLORS = ((46, 64, 140), (38, 146, 140), (240, 205, 70), (205, 55, 45))


class MeshCache:
    """Meshes and vertex colours of the objects of one recording; every shape is decoded once."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._meshes: dict[tuple[int, int | None], TriangleMesh | None] = {}
        self._colors: dict[int, np.ndarray | None] = {}

    @cached_property
    def _decoder(self) -> ShapeDecoder:
        return ShapeDecoder.load()

    def mesh(self, state: ObjectState) -> TriangleMesh | None:
        """Return the surface in the object frame in metres; None if the code decodes to an empty shape."""
        key = (state.id, state.iteration)
        if key not in self._meshes:
            self._meshes[key] = self._make_mesh(state)
        return self._meshes[key]

    def uncertainty_colors(self, state: ObjectState) -> UInt8[np.ndarray, "v 3"] | None:
        """Return a colour per vertex of a reconstructed object; None during its fit or without covariance."""
        if state.iteration is not None:
            return None
        if state.id not in self._colors:
            estimate = self._estimate(state.id)
            self._colors[state.id] = None if estimate is None else self._make_colors(estimate)
        return self._colors[state.id]

    def _make_mesh(self, state: ObjectState) -> TriangleMesh | None:
        estimate = self._estimate(state.id)
        if state.iteration is None and estimate is not None:
            return estimate.mesh
        try:
            return mesh_from_code(self._decoder, state.category, state.code, state.scale)
        except PerceptionError:
            return None

    def _make_colors(self, estimate: ObjectEstimate) -> UInt8[np.ndarray, "v 3"] | None:
        covariance = estimate.covariance
        if covariance is None:
            covariance = self._recorded_covariance(estimate.id)
        if covariance is None:
            return None
        decoded = self._decoder.with_jacobian(estimate.category, estimate.code)
        return deviation_colors(surface_deviation(estimate, covariance, *decoded))

    def _estimate(self, id: int) -> ObjectEstimate | None:
        return next((estimate for estimate in self._recorder.objects if estimate.id == id), None)

    def _recorded_covariance(self, id: int) -> Float[np.ndarray, "25 25"] | None:
        """Return the covariance from its recorded upper triangle."""
        for note in self._recorder.notes:
            if note.kind == "objects" and str(id) in note.data["covariances"]:
                covariance = np.zeros((25, 25))
                covariance[np.triu_indices(25)] = note.data["covariances"][str(id)]
                return covariance + np.triu(covariance, 1).T
        return None


def deviation_colors(deviation: Float[np.ndarray, "v"]) -> UInt8[np.ndarray, "v 3"]:
    """Return the colours of standard deviations [m], interpolated linearly and saturated at MAX_DEVIATION."""
    colors = np.array(UNCERTAINTY_COLORS, dtype=np.float64)
    position = np.clip(deviation / MAX_DEVIATION, 0, 1) * (len(colors) - 1)
    low = np.minimum(position.astype(int), len(colors) - 2)
    share = (position - low)[:, None]
    return ((1 - share) * colors[low] + share * colors[low + 1]).astype(np.uint8)
