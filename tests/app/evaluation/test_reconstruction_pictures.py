"""Pictures of a reconstruction evaluation."""

import numpy as np
import trimesh

from app.evaluation.reconstruction_pictures import _convergence_plot, _shaded
from perception.types import TriangleMesh


def test_convergence_plot_has_a_curve_for_each_method_and_the_end_of_the_budget() -> None:
    curves = {name: {"iteration": [0, 8], "chamfer_l1": [0.02, 0.01]} for name in ("full", "dvr")}
    assert len(_convergence_plot(curves).axes[0].lines) == 3


def test_a_picture_of_a_mesh_is_lit_and_centred() -> None:
    ball = trimesh.creation.icosphere(3, 0.05)
    mesh = TriangleMesh(ball.vertices, ball.faces)
    image = _shaded(mesh, np.full((len(mesh.faces), 3), 200.0), np.array([0.4, 0, 0.3]), np.zeros(3), 0.05)
    covered = (image < 255).any(axis=2)
    assert covered[170, 170] and not covered[0].any() and not covered[:, -1].any()
    assert image[100, 170].mean() > image[240, 170].mean()  # light comes from above
