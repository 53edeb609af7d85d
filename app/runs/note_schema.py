"""Validation of the notes of a recording; ``app.runs.replay.Note`` lists their fields."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from perception.io.arrays import numbers_of
from perception.types import CATEGORIES, CODE_SIZE, check_rigid

Check = Callable[[Any], None]  # raises ValueError, with what the value must be
MAX_NUMBER = 1e9  # of arrays: products of larger ones overflow
MAX_LENGTH = 1e4  # [m] of positions
COVARIANCE_TRIANGLE = 325  # elements of the upper triangle of a 25 x 25 matrix


def check_note(kind: str, data: Mapping[str, Any]) -> None:
    """Check the fields of a note; unknown fields are ignored.

    Raises:
        ValueError: A field is missing or invalid; the message names it.
    """
    for name, check in REQUIRED[kind].items():
        if name not in data:
            raise ValueError(f"{name} is missing")
        _check_field(name, check, data[name])
    for name, check in OPTIONAL.get(kind, {}).items():
        if name in data:
            _check_field(name, check, data[name])
    if data.get("grasps") and "T_stand_tcp" not in data:
        raise ValueError("T_stand_tcp is missing")


def is_finite_number(value: Any) -> bool:
    """Return whether a JSON value is a number in the range of a float."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and abs(value) <= sys.float_info.max


def _check_field(name: str, check: Check, value: Any) -> None:
    try:
        check(value)
    except ValueError as error:
        raise ValueError(f"{name} {error}") from None


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _text(value: Any) -> None:
    _require(isinstance(value, str), "must be text")


def _count(value: Any) -> None:
    _require(type(value) is int and value >= 0, "must be a non-negative integer")


def _number(value: Any) -> None:
    _require(is_finite_number(value), "must be a finite number")


def _not_negative(value: Any) -> None:
    _number(value)
    _require(value >= 0, "must not be negative")


def _not_negative_or_none(value: Any) -> None:
    if value is not None:
        _not_negative(value)


def _category(value: Any) -> None:
    _require(value in CATEGORIES, f"must be one of {', '.join(CATEGORIES)}")


def _numbers(*shape: int | None, limit: float = MAX_NUMBER) -> Check:
    """Return a check for numbers of a shape, in which None stands for any size, and of limited magnitude."""
    size = " x ".join("n" if count is None else str(count) for count in shape)

    def check(value: Any) -> None:
        try:
            array = numbers_of(value)
        except ValueError:
            array = np.full(1, np.nan)
        fits = array.ndim == len(shape) and bool((np.abs(array) <= limit).all())  # NaN fails as well
        sizes = zip(shape, array.shape, strict=False)
        _require(
            fits and all(count in (None, actual) for count, actual in sizes),
            f"must hold {size} finite numbers of at most {limit:g} in magnitude",
        )

    return check


def _scale(value: Any) -> None:
    _numbers(3, limit=MAX_LENGTH)(value)
    _require(min(value) > 0, "must be positive")


def _points(value: Any) -> None:
    _numbers(None, 3, limit=MAX_LENGTH)(value)
    _require(len(value) >= 2, "must hold at least 2 points")


def _pose(value: Any) -> None:
    _numbers(4, 4, limit=MAX_LENGTH)(value)
    check_rigid(np.asarray(value, dtype=np.float64), "it")


def _poses(value: Any) -> None:
    _require(isinstance(value, list), "must be a list")
    for pose in value:
        _pose(pose)


def _mapping_of(check: Check) -> Check:
    def check_all(value: Any) -> None:
        _require(isinstance(value, dict), "must be an object")
        for name, entry in value.items():
            _check_field(f"of {name}", check, entry)

    return check_all


def _pieces(value: Any) -> None:
    _require(isinstance(value, list) and len(value) > 0, "must be a list of pieces")
    for piece in value:
        _numbers(None, 3, limit=MAX_LENGTH)(piece)
        _require(len(piece) >= 4, "must hold pieces of at least 4 points")


def _placements(value: Any) -> None:
    _require(isinstance(value, list), "must be a list")
    for index, placement in enumerate(value):
        _require(isinstance(placement, dict), "must hold objects")
        for name, check in PLACEMENT.items():
            _require(name in placement, f"{index}: {name} is missing")
            _check_field(f"{index}: {name}", check, placement[name])


PLACEMENT: Mapping[str, Check] = {
    "name": _text,
    "T_world_stand": _pose,
    "position": _numbers(3, limit=MAX_LENGTH),
    "yaws": _numbers(None),
}
REQUIRED: Mapping[str, Mapping[str, Check]] = {
    "stage": {"name": _text},
    "done": {"name": _text, "seconds": _not_negative},
    "look": {"index": _count},
    "found": {"index": _count, "count": _count},
    "fit": {
        "id": _count,
        "category": _category,
        "iteration": _count,
        "code": _numbers(CODE_SIZE),
        "T_world_object": _pose,
        "scale": _scale,
        "residual": _not_negative_or_none,
    },
    "objects": {"covariances": _mapping_of(_numbers(COVARIANCE_TRIANGLE))},
    "obstacles": {"pieces": _mapping_of(_pieces)},
    "plan": {"placements": _placements, "left_out": _mapping_of(_text)},
    "action": {"phase": _text, "name": _text, "message": _text},
    "path": {"points": _points},
}
OPTIONAL: Mapping[str, Mapping[str, Check]] = {
    "path": {"name": _text},
    "action": {
        "done": _count,
        "total": _count,
        "T_stand_tcp": _pose,
        "T_world_stand_rest": _pose,
        "grasps": _poses,
    },
}
