"""Meshes and colours of believed objects; made once each, because decoding takes its time."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8

from app.runs.replay import Recorder
from app.viewer.snapshot import Believed
from perception.errors import PerceptionError
from perception.inference.meshing import mesh_from_code
from perception.inference.shape_model import decode_with_jacobian
from perception.inference.uncertainty import surface_deviation
from perception.shape.decoder import ShapeDecoder
from perception.types import ObjectEstimate, TriangleMesh

UNSURE = 0.006  # [m] one standard deviation that gets the last colour
# From sure to unsure: dark blue, teal, yellow, red.
UNSURE_COLORS = ((46, 64, 140), (38, 146, 140), (240, 205, 70), (205, 55, 45))
_SCALE = np.array(UNSURE_COLORS, dtype=np.float64)


class Meshes:
    """Looks shapes up, decodes what is new."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._meshes: dict[tuple[int, int | None], TriangleMesh | None] = {}
        self._colors: dict[int, np.ndarray | None] = {}

    @cached_property
    def _decoder(self) -> ShapeDecoder:
        return ShapeDecoder.load()

    def mesh(self, believed: Believed) -> TriangleMesh | None:
        """Its surface in the object frame in [m]; None while its code means no shape."""
        key = (believed.id, believed.iteration)
        if key not in self._meshes:
            self._meshes[key] = self._make(believed)
        return self._meshes[key]

    def uncertainty_colors(self, believed: Believed) -> UInt8[np.ndarray, "v 3"] | None:
        """A colour for each vertex of the finished mesh; None where the uncertainty is not known."""
        if believed.iteration is not None:
            return None
        if believed.id not in self._colors:
            estimate = self._estimate(believed.id)
            self._colors[believed.id] = estimate and self._unsure(estimate)
        return self._colors[believed.id]

    def _make(self, believed: Believed) -> TriangleMesh | None:
        estimate = self._estimate(believed.id)
        if believed.iteration is None and estimate is not None:
            return estimate.mesh
        try:
            return mesh_from_code(self._decoder, believed.category, believed.code, believed.scale)
        except PerceptionError:
            return None

    def _estimate(self, number: int) -> ObjectEstimate | None:
        return next((estimate for estimate in self._recorder.objects if estimate.id == number), None)

    def _unsure(self, estimate: ObjectEstimate) -> np.ndarray | None:
        covariance = estimate.covariance
        if covariance is None:
            covariance = self._recorded_covariance(estimate.id)
        if covariance is None:
            return None
        decoded = decode_with_jacobian(self._decoder, estimate.category, estimate.code)
        return colors_of(surface_deviation(estimate, covariance, *decoded))

    def _recorded_covariance(self, number: int) -> Float[np.ndarray, "25 25"] | None:
        for note in self._recorder.notes:
            if note.kind == "objects" and str(number) in note.data["covariances"]:
                upper = np.triu_indices(25)
                covariance = np.zeros((25, 25))
                covariance[upper] = note.data["covariances"][str(number)]
                return covariance + np.triu(covariance, 1).T
        return None


def colors_of(deviation: Float[np.ndarray, "v"]) -> UInt8[np.ndarray, "v 3"]:
    """From sure to unsure."""
    place = np.clip(deviation / UNSURE, 0, 1) * (len(_SCALE) - 1)
    low = np.minimum(place.astype(int), len(_SCALE) - 2)
    share = (place - low)[:, None]
    return ((1 - share) * _SCALE[low] + share * _SCALE[low + 1]).astype(np.uint8)
