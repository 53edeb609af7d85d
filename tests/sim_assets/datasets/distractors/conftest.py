"""What holds for every kind of distractor and surrounding."""

import numpy as np
import pytest

from sim_assets.rendering.surfaces import PAINTERS
from sim_assets.rendering.texture_coordinates import ATLAS, ATTRIBUTE, CELLS


def _check(kind, largest):
    rng = np.random.default_rng(3)
    for _ in range(4):
        mesh = kind(rng)
        assert np.isfinite(mesh.vertices).all()
        assert mesh.extents.min() > 0.002 and mesh.extents.max() < largest
        assert len(mesh.faces) <= 2000
        assert mesh.volume > 0  # outward normals
        surfaces = mesh.metadata["surfaces"]
        assert set(surfaces) <= {*PAINTERS, "print", "any"} and len(surfaces) <= CELLS
        uv = mesh.face_attributes[ATTRIBUTE]
        assert uv.shape == (len(mesh.faces), 3, 2) and (uv > 0).all() and (uv < 1).all()
        cell = np.floor(uv[..., 1] * ATLAS[0]) * ATLAS[1] + np.floor(uv[..., 0] * ATLAS[1])
        assert (cell == cell[:, :1]).all()  # no triangle over two cells
        assert cell.max() < len(surfaces)
    first, again = (kind(np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, again.vertices)


@pytest.fixture
def check_kind():
    return _check
