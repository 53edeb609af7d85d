"""Normal equations of bundle adjustment and their solution by the Schur complement.

Objects are coupled through the cameras alone. With c the step of the cameras and o_i that of object i, the
damped normal equations

    [H_cc  H_co] [c]     [g_c]
    [H_oc  H_oo] [o] = - [g_o],      H_oo block diagonal, 25 x 25 for each object,

reduce to (H_cc - sum H_ci H_ii^-1 H_ic) c = -(g_c - sum H_ci H_ii^-1 g_i); back-substitution gives each o_i.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_FLOOR = 1e-9  # of the largest diagonal entry: keeps unobserved directions solvable, with step 0


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of the normal equations of one window; c is 6 for each free camera.

    Attributes:
        cameras: H_cc.
        objects: H_ii of each object.
        coupling: H_ic of each object.
        gradient_cameras: g_c.
        gradient_objects: g_i of each object.
    """

    cameras: Float[np.ndarray, "c c"]
    objects: Float[np.ndarray, "o 25 25"]
    coupling: Float[np.ndarray, "o 25 c"]
    gradient_cameras: Float[np.ndarray, "c"]
    gradient_objects: Float[np.ndarray, "o 25"]


def solve_by_schur(
    equations: NormalEquations, damping: float
) -> tuple[Float[np.ndarray, "c"], Float[np.ndarray, "o 25"]]:
    """Return the steps of cameras and objects that solve the damped equations (see the module docstring).

    Args:
        equations: Undamped normal equations.
        damping: Levenberg-Marquardt's factor on the diagonal that is added.
    """
    cameras, objects = (_damped(H, damping) for H in (equations.cameras, equations.objects))
    right = np.concatenate([equations.coupling, equations.gradient_objects[..., None]], axis=-1)
    solved = np.linalg.solve(objects, right) if len(objects) else right
    A, b = solved[..., :-1], solved[..., -1]  # H_ii^-1 H_ic, H_ii^-1 g_i
    reduced = cameras - np.einsum("oic,oid->cd", equations.coupling, A)
    rest = equations.gradient_cameras - np.einsum("oic,oi->c", equations.coupling, b)
    step = -np.linalg.solve(reduced, rest) if len(rest) else -rest
    return step, -b - A @ step


def _damped(H: Float[np.ndarray, "*batch n n"], damping: float) -> Float[np.ndarray, "*batch n n"]:
    diagonal = np.diagonal(H, axis1=-2, axis2=-1)
    floor = _FLOOR * np.maximum(diagonal.max(axis=-1, keepdims=True, initial=0.0), 1e-12)
    return H + np.eye(H.shape[-1]) * (damping * diagonal + floor)[..., None, :]
