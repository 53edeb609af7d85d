"""Handle curves: C, D, ear and square, each in a training and a test construction.

A curve lives in the unit frame of its handle: a >= 0 outwards, b from +1 (upper root) to -1 (lower root).

| style  | train (superellipse, apex raised)            | test                                               |
| ------ | -------------------------------------------- | -------------------------------------------------- |
| c      | half ellipse, exponent 1.9-2.3               | ring: circle arc of 220-260 degrees                |
| d      | superellipse, exponent 2.6-3.4               | filleted polygon, lower arm slanted                |
| ear    | exponent 1.9-2.6, apex raised by 0.2-0.45    | cubic Bézier, long lower tail                      |
| square | superellipse, exponent 4.5-7                 | filleted rectangle, upright leaning in or out      |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sim_assets.objects.profiles import Curve, fillet, resample, superellipse_arc
from sim_assets.objects.solids import Handle
from sim_assets.objects.vessel import Vessel

HandleStyle = Literal["c", "d", "ear", "square"]
HandleCurve = Literal["superellipse", "ring", "slanted", "bezier", "rectangle"]
POINTS = 44  # along a centreline


@dataclass(frozen=True)
class HandleParameters:
    """A mug's handle, lengths in [m].

    Attributes:
        style: name of the handle's shape.
        curve: construction of the centreline.
        shape: first parameter of the curve: exponent, arc angle [rad], slant, tail, or lean.
        apex: elevation of the superellipse's farthest point, in half heights.
        depth: distance from the body's surface to the centreline's farthest point.
        top, bottom: heights of the roots above the base.
        thickness, width: full extent of the section in the plane of the handle and across it.
        taper: ratio of the lower root's section to the upper root's.
        root: relative thickening of the roots over the middle.
        exponent: exponent of the superelliptic section.
    """

    style: HandleStyle
    curve: HandleCurve
    shape: float
    apex: float
    depth: float
    top: float
    bottom: float
    thickness: float
    width: float
    taper: float
    root: float
    exponent: float


def unit_curve(parameters: HandleParameters) -> Curve:
    """Return the (k, 2) centreline (a, b) from (0, 1) to (0, -1), largest a = 1."""
    make = {
        "superellipse": _superellipse,
        "ring": _ring,
        "slanted": _slanted,
        "bezier": _bezier,
        "rectangle": _rectangle,
    }[parameters.curve]
    curve = make(parameters)
    curve[:, 0] /= curve[:, 0].max()
    return curve


def make_handle(parameters: HandleParameters, vessel: Vessel) -> Handle:
    """Return the handle attached to a vessel's side; its ends reach into the wall."""
    unit = unit_curve(parameters)
    middle, half = 0.5 * (parameters.top + parameters.bottom), 0.5 * (parameters.top - parameters.bottom)
    z = middle + half * unit[:, 1]
    roots = vessel.outer_radius(np.array([parameters.bottom, parameters.top]))
    base = np.interp(z, [parameters.bottom, parameters.top], roots)
    curve = np.stack([base + parameters.depth * unit[:, 0], z], axis=1)
    sunk = np.array([max(0.004, 0.8 * parameters.thickness), 0.0])
    curve = resample(np.concatenate([[curve[0] - sunk], curve, [curve[-1] - sunk]]), POINTS)
    at = np.linspace(-1.0, 1.0, POINTS)
    section = (1.0 + 0.5 * (at + 1.0) * (parameters.taper - 1.0)) * (1.0 + parameters.root * at**6)
    return Handle(
        curve, 0.5 * parameters.thickness * section, 0.5 * parameters.width * section, parameters.exponent
    )


def _superellipse(parameters: HandleParameters) -> Curve:
    curve = superellipse_arc(parameters.shape)
    curve[:, 1] += parameters.apex * (1.0 - curve[:, 1] ** 2)
    return curve


def _ring(parameters: HandleParameters) -> Curve:
    """Return an arc of more than half a circle."""
    half = 0.5 * parameters.shape
    angle = np.linspace(half, -half, 120)
    curve = np.stack([np.cos(angle) - np.cos(half), np.sin(angle) / np.sin(half)], axis=1)
    return curve


def _slanted(parameters: HandleParameters) -> Curve:
    """Return straight upper arm and upright, and a lower arm slanting down from `shape` above its root."""
    corners = np.array([(0.0, 1.0), (1.0, 1.0), (1.0, -1.0 + parameters.shape), (0.0, -1.0)])
    return fillet(corners, np.array([0.0, 0.5, 0.5, 0.0]), segments=10)


def _bezier(parameters: HandleParameters) -> Curve:
    """Return an ear: wide at the top, with a tail that tapers into the body."""
    control = np.array([(0.0, 1.0), (1.5, 1.35), (1.2, -parameters.shape), (0.0, -1.0)])
    t = np.linspace(0.0, 1.0, 120)[:, None]
    s = 1.0 - t
    return s**3 * control[0] + 3 * s**2 * t * control[1] + 3 * s * t**2 * control[2] + t**3 * control[3]


def _rectangle(parameters: HandleParameters) -> Curve:
    """Return straight arms and an upright that leans by `shape`, with rounded corners."""
    lean = 0.5 * parameters.shape
    corners = np.array([(0.0, 1.0), (1.0 + lean, 1.0), (1.0 - lean, -1.0), (0.0, -1.0)])
    return fillet(corners, np.array([0.0, 0.35, 0.35, 0.0]), segments=10)
