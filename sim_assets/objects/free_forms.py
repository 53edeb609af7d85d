"""Bodies of free form for training: cans and bottles with random smooth or beaded sides.

What makes a can or a bottle is not the curve of its side: a can is closed and about as wide at its ends as
between them, a bottle narrows to a neck. The families have few curves, and networks trained on these alone
take any other can with curved sides for a bottle. A free form is a member of a training family whose side
is replaced by random radii; it covers what the test families do without having their formulas.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sim_assets.objects.bottle import BottleParameters
from sim_assets.objects.can import CanParameters
from sim_assets.objects.families import Parameters
from sim_assets.objects.profiles import body_curve

_CONTROLS = (3, 6)  # smallest and largest number of radii of a smooth side
_DEPTH = (0.02, 0.28)  # difference between largest and smallest radius, relative to the largest
_BEADED = 0.35  # share of the sides with beads or ribs
_BEAD_DEPTH, _BEAD_PITCH = (0.01, 0.10), (0.006, 0.022)  # relative to the radius; along the axis [m]
_MOST_BEADS = 16
_WIDER_ABOVE = 1.06  # what widens upwards more than that is a tumbler, which counts as a bottle


def free_form(parameters: Parameters, rng: np.random.Generator) -> Parameters:
    """Return a can or a bottle with a side of random form; other objects as they are."""
    match parameters:
        case CanParameters():
            radii = _random_radii(parameters.height, rng)
            if radii[-1] > _WIDER_ABOVE * radii[0]:
                radii = radii[::-1]
            kind = parameters.kind if parameters.kind in ("plain", "canister") else "food"
            return replace(
                parameters, kind=kind, bend=0.0, neck=0.0, neck_height=0.001, dome=0.0, foot=0.0, radii=radii,
                seam=parameters.seam or float(rng.uniform(0.0006, 0.0018)),
            )  # fmt: skip
        case BottleParameters():
            if parameters.top in ("lid", "dome"):  # the lid of a tumbler is as wide as its body
                return parameters
            radii = _random_radii(parameters.body_top, rng)
            least = min(1.0, parameters.neck_radius / (parameters.radius * parameters.aspect))
            return replace(parameters, bend=0.0, radii=(*radii[:-1], max(radii[-1], least)))
        case _:
            return parameters


def _random_radii(height: float, rng: np.random.Generator) -> tuple[float, ...]:
    """Return relative radii at equal steps of the height [m], at most 1: a smooth curve, perhaps beaded."""
    controls = rng.random(int(rng.integers(*_CONTROLS, endpoint=True)))
    controls = 1.0 - rng.uniform(*_DEPTH) * (controls - controls.min()) / max(float(np.ptp(controls)), 1e-6)
    if rng.random() >= _BEADED:
        return tuple(controls.tolist())
    beads = int(np.clip(height / rng.uniform(*_BEAD_PITCH), 2, _MOST_BEADS))
    along = np.linspace(0.0, 1.0, 2 * beads + 1)
    radii = body_curve(controls.tolist(), along)
    radii[1::2] *= 1.0 - rng.uniform(*_BEAD_DEPTH)
    return tuple((radii / radii.max()).tolist())
