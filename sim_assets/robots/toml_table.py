"""Validated reading of TOML tables that collects all problems instead of stopping at the first."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sim_assets.robots.mounting import Frame, SitePose

MAX_NUMBER = 1e6  # of any entry
MAX_DISTANCE = 10.0  # of the base from the origin, along each axis [m]


@dataclass
class TomlTable:
    """A table of a robot file.

    A wrong entry adds a line to ``problems`` and reads as an empty or neutral value, so that the rest of the
    file can be checked as well.

    Attributes:
        name: name of the table; empty at the top level.
        entries: its entries.
        problems: shared by all tables of the file.
    """

    name: str
    entries: dict[str, Any]
    problems: list[str]
    _known: set[str] = field(default_factory=set)

    def __contains__(self, key: str) -> bool:
        return key in self.entries

    def table(self, key: str, optional: bool = False) -> TomlTable:
        """Return a sub-table; an optional one that is missing is empty."""
        entries = self._take(key, {} if optional else None)
        if entries is not None and not isinstance(entries, dict):
            self.problems.append(f"[{key}] must be a table")
        return TomlTable(key, entries if isinstance(entries, dict) else {}, self.problems)

    def text(self, key: str, default: str | None = None) -> str:
        value = self._take(key, default)
        if value is None or (isinstance(value, str) and (value or value == default)):
            return value or ""
        return self._wrong(key, "a name in quotes", "")

    def path(self, key: str, folder: Path) -> Path:
        """Return a path, relative to ``folder``, with ``~`` and environment variables expanded."""
        text = os.path.expandvars(os.path.expanduser(self.text(key)))
        if "$" in text:
            variable = text.split("$")[1].strip("{").split("/")[0].split("}")[0]
            self.problems.append(f"{self._called(key)}: set the environment variable {variable}")
        return folder / text

    def names(self, key: str, counts: Sequence[int] = (), optional: bool = False) -> tuple[str, ...]:
        """Return different names, as many as one of ``counts``."""
        values = self._take(key, [] if optional else None)
        if values is None or (optional and key not in self.entries):
            return ()
        if not isinstance(values, list) or not values or not all(isinstance(v, str) and v for v in values):
            return self._wrong(key, "a list of names in quotes", ())
        if not self._check_count(key, values, counts):
            return ()
        if len(set(values)) < len(values):
            return self._wrong(key, "a list of different names", ())
        return tuple(values)

    def number(self, key: str, default: float | None = None) -> float:
        value = self._take(key, default)
        if value is None:
            return 0.0
        if not _is_number(value, MAX_NUMBER):
            return self._wrong(key, f"a finite number of at most {MAX_NUMBER:g} in magnitude", 0.0)
        return float(value)

    def positive(self, key: str, most: float = np.inf, default: float | None = None) -> float:
        before = len(self.problems)
        value = self.number(key, default)
        if len(self.problems) == before and not 0 < value <= most:
            return self._wrong(key, f"above 0 and at most {most:g}" if np.isfinite(most) else "above 0", 1.0)
        return value

    def between(self, key: str, least: float, most: float, default: float) -> float:
        before = len(self.problems)
        value = self.number(key, default)
        if len(self.problems) == before and not least <= value <= most:
            return self._wrong(key, f"of {least:g} to {most:g}", default)
        return value

    def numbers(
        self, key: str, count: int, default: Sequence[float] | None = None, most: float = MAX_NUMBER
    ) -> Float[np.ndarray, "_count"]:
        values = self._take(key, list(default) if default is not None else None)
        neutral = np.zeros(count)
        if values is None:
            return neutral
        if not isinstance(values, list):
            return self._wrong(key, f"a list of {count} numbers", neutral)
        if not self._check_count(key, values, (count,) if count else ()):
            return neutral
        if not all(_is_number(value, most) for value in values):
            return self._wrong(
                key, f"a list of {count} finite numbers of at most {most:g} in magnitude", neutral
            )
        return np.array(values, dtype=np.float64)

    def positive_numbers(
        self, key: str, count: int, default: Sequence[float] | None = None
    ) -> Float[np.ndarray, "_count"]:
        before = len(self.problems)
        values = self.numbers(key, count, default)
        if len(self.problems) == before and not (values > 0).all():
            return self._wrong(key, "a list of numbers above 0", np.ones(count))
        return values

    def limits(self, key: str, count: int, least: float, most: float) -> Float[np.ndarray, "_count"]:
        before = len(self.problems)
        values = self.numbers(key, count)
        if len(self.problems) == before and not ((values >= least) & (values <= most)).all():
            return self._wrong(key, f"a list of numbers of {least:g} to {most:g}, in radians", np.ones(count))
        return values

    def site(self, key: str, name: str) -> tuple[str, SitePose | None]:
        """Return the name of a site or, if the file gives body and pose, ``name`` and the site to add."""
        if isinstance(self.entries.get(key), dict):
            pose = replace(self.table(key), name=f"{self.name}.{key}")
            place = Frame(pose.numbers("position", 3), pose.quaternion("quaternion"))
            site = SitePose(name, pose.text("body"), place)
            pose.refuse_others()
            return name, site
        return self.text(key), None

    def quaternion(self, key: str) -> Float[np.ndarray, "4"]:
        """Return a unit quaternion wxyz; by default that of no rotation."""
        value = self.numbers(key, 4, (1.0, 0.0, 0.0, 0.0))
        length = float(np.linalg.norm(value))
        if length < 1e-6:
            self.problems.append(f"{self._called(key)} must not be zero")
            return np.array([1.0, 0.0, 0.0, 0.0])
        return value / length

    def refuse_others(self) -> None:
        """Report the entries that no call has asked for."""
        known = ", ".join(sorted(self._known))
        for key in sorted(set(self.entries) - self._known):
            self.problems.append(f"{self._called(key)} is unknown; known are {known}")

    def _take(self, key: str, default: Any = None) -> Any:
        self._known.add(key)
        value = self.entries.get(key, default)
        if value is None:
            self.problems.append(f"{self._called(key)} is missing")
        return value

    def _check_count(self, key: str, values: Sequence[Any], counts: Sequence[int]) -> bool:
        if counts and len(values) not in counts:
            expected = " or ".join(map(str, counts))
            self.problems.append(f"{self._called(key)} has {len(values)} entries, expected {expected}")
            return False
        return True

    def _wrong(self, key: str, wanted: str, neutral: Any) -> Any:
        self.problems.append(f"{self._called(key)} = {_shortened(self.entries.get(key))} must be {wanted}")
        return neutral

    def _called(self, key: str) -> str:
        return f"[{self.name}] {key}" if self.name else key


def _is_number(value: Any, most: float) -> bool:
    """Return whether an entry is a number of at most the given magnitude; NaN is none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= most


def _shortened(value: Any) -> str:
    """Return an entry for a message; Python refuses to print integers of thousands of digits."""
    try:
        text = repr(value)
    except ValueError:
        return "a very long integer"
    return text if len(text) <= 80 else f"{text[:77]}..."
