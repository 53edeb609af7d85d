"""Small pictures for the panel as HTML and SVG: time line, table, curves, bars. Text is escaped here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from app.drawing import CLASS_COLORS
from app.viewer.snapshot import STAGE_NAMES, Believed, StageSpan
from perception.types import CATEGORIES, Category, ObjectEstimate

INK, FAINT, ACCENT, GOOD, BAD = "#22252b", "#7a7f8a", "#1f6fd0", "#1b7f5c", "#c23b22"
_FONT = "font-family:Inter,system-ui,sans-serif"


Curve = tuple[Sequence[float], Sequence[float], Category]  # x, y, class


def css(color: tuple[int, int, int]) -> str:
    return "#" + "".join(f"{value:02x}" for value in color)


def header(title: str, subtitle: str) -> str:
    """The name of what is shown."""
    return (
        f'<div style="{_FONT};padding:0 0.75em"><div style="font-size:1.15em;font-weight:650">'
        f'{escape(title)}</div><div style="color:{FAINT};font-size:0.85em">{escape(subtitle)}</div></div>'
    )


def timeline(
    stages: Sequence[StageSpan], now: float, caption: str, titles: Mapping[str, str] = STAGE_NAMES
) -> str:
    """The stages in a row, by ``titles``: done, running, to come; how long each took; what happens now."""
    spans = {span.name: span for span in stages}
    current = next((span.name for span in reversed(stages) if span.begin <= now), "")
    names = list(titles)
    reached = names.index(current) if current in names else -1
    cells = []
    for index, (name, title) in enumerate(titles.items()):
        span = spans.get(name)
        took = f"{span.seconds:.0f} s" if span is not None and span.seconds is not None else "&nbsp;"
        bar = GOOD if index < reached else ACCENT if index == reached else "#d5d8de"
        weight = 650 if index == reached else 450
        cells.append(
            f'<div style="flex:1 1 auto;text-align:center">'
            f'<div style="height:5px;border-radius:3px;background:{bar};margin-bottom:3px"></div>'
            f'<div style="font-size:0.72em;font-weight:{weight}">'
            f'{title}</div><div style="font-size:0.66em;color:{FAINT}">{took}</div></div>'
        )
    return (
        f'<div style="{_FONT};padding:0 0.75em"><div style="display:flex;gap:4px">{"".join(cells)}</div>'
        f'<div style="margin-top:4px;min-height:2.6em;line-height:1.3;font-size:0.85em">'
        f"{escape(caption)}</div></div>"
    )


def object_table(
    objects: Mapping[int, Believed],
    estimates: Sequence[ObjectEstimate],
    results: Mapping[int, Mapping[str, Any]],
) -> str:
    """Per object: class, size, score, status. ``results`` are the report's entries, by id."""
    known = {estimate.id: estimate for estimate in estimates}
    rows = []
    for number, believed in sorted(objects.items()):
        estimate = known.get(number)
        details = f"iteration {believed.iteration}" if believed.iteration is not None else ""
        if estimate is not None and believed.iteration is None:
            details = (
                f"{200 * estimate.radius:.1f} × {100 * estimate.height:.1f} cm · "
                f"score {estimate.score:.2f} · {estimate.n_views} views"
            )
        if believed.residual is not None:
            details += f" · residual {1000 * believed.residual:.1f} mm"
        verdict, color = _verdict(believed, results.get(number, {}))
        rows.append(
            f'<div style="display:flex;gap:0.6em;padding:0.45em 0;border-top:1px solid #e6e8ec">'
            f'<div style="width:0.8em;height:0.8em;border-radius:50%;margin-top:0.25em;flex:none;'
            f'background:{css(CLASS_COLORS[believed.category])}"></div><div style="min-width:0">'
            f"<b>{escape(believed.name.replace('_', ' '))}</b> "
            f'<span style="color:{color}">{escape(verdict)}</span>'
            f'<div style="color:{FAINT};font-size:0.85em">{escape(details)}</div></div></div>'
        )
    content = "".join(rows) or f'<div style="color:{FAINT}">No object has been found yet.</div>'
    return f'<div style="{_FONT};padding:0 0.75em;font-size:0.9em">{content}</div>'


def _verdict(believed: Believed, result: Mapping[str, Any]) -> tuple[str, str]:
    placed = result.get("placed")
    if believed.status == "put down" and placed:
        error = result.get("error_position")
        return f"in place, {1000 * error:.0f} mm from plan" if error is not None else "in place", GOOD
    if believed.status == "left":
        return believed.reason or "left where it is", BAD
    return believed.status, ACCENT if believed.status in ("fitting", "next", "in the hand") else FAINT


def note(text: str) -> str:
    """A quiet line."""
    return f'<div style="{_FONT};padding:0 0.75em;color:{FAINT};font-size:0.85em">{escape(text)}</div>'


def legend() -> str:
    """Which colour is which class."""
    entries = "".join(
        f'<span style="margin-right:0.9em;white-space:nowrap"><span style="display:inline-block;width:0.8em;'
        f'height:0.8em;border-radius:50%;background:{css(CLASS_COLORS[category])}"></span> {category}</span>'
        for category in CATEGORIES
    )
    return f'<div style="{_FONT};padding:0 0.75em;font-size:0.85em">{entries}</div>'


def scale(low: str, high: str, colors: Sequence[tuple[int, int, int]]) -> str:
    """What a run of colours means, from low to high."""
    return (
        f'<div style="{_FONT};padding:0 0.75em;font-size:0.85em;display:flex;gap:0.6em;align-items:center">'
        f'{escape(low)}<span style="flex:1;height:0.7em;border-radius:0.35em;background:'
        f'linear-gradient(to right,{",".join(css(color) for color in colors)})"></span>{escape(high)}</div>'
    )


def curves(title: str, lines: Mapping[str, Curve], unit: str) -> str:
    """Curves over iterations, by name."""
    width, height, left, bottom = 340, 150, 34, 20
    xs = [x for line in lines.values() for x in line[0]]
    ys = [y for line in lines.values() for y in line[1]]
    x_end, y_end = max([*xs, 1.0]), 1.1 * max([*ys, 1e-9])
    shapes = [_axes(width, height, left, bottom, y_end, unit)]
    for name, (x, y, category) in lines.items():
        points = [
            (left + (width - left - 46) * a / x_end, (height - bottom) * (1 - b / y_end))
            for a, b in zip(x, y, strict=True)
        ]
        if not points:
            continue
        path = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
        color = css(CLASS_COLORS[category])
        shapes.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        a, b = points[-1]
        shapes.append(
            f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="{color}"/><text x="{a + 5:.1f}" y="{b + 3:.1f}" '
            f'font-size="9" fill="{INK}">{escape(name.replace("_", " "))}</text>'
        )
    if not xs:
        shapes.append(_text(left + (width - left) / 2, height / 2 - 16, "nothing has been fitted"))
    shapes.append(_text(left + (width - left) / 2, height - 4, "iteration of the optimiser"))
    return _svg(title, width, height, shapes)


def bars(title: str, values: Sequence[float], category: Category) -> str:
    """One bar for each number of a shape code; a standard normal is its prior."""
    width, height, left, bottom = 340, 120, 34, 20
    span = max(2.5, float(np.abs(values).max()) * 1.1 if len(values) else 0.0)
    middle = (height - bottom) / 2
    shapes = [
        f'<line x1="{left}" x2="{width - 8}" y1="{middle}" y2="{middle}" stroke="#b9bec8"/>',
        _text(left - 4, middle + 3, "0", "end"),
        _text(left - 4, 9, f"{span:.1f}", "end"),
    ]
    step = (width - left - 8) / max(len(values), 1)
    for index, value in enumerate(values):
        size = middle * abs(value) / span
        top = middle - size if value > 0 else middle
        shapes.append(
            f'<rect x="{left + step * index + 2:.1f}" y="{top:.1f}" width="{step - 4:.1f}" '
            f'height="{size:.1f}" rx="1.5" fill="{css(CLASS_COLORS[category])}"/>'
        )
    if not np.any(values):
        shapes.append(_text(left + (width - left) / 2, middle - 16, "this shape came without a code"))
    shapes.append(_text(left + (width - left) / 2, height - 4, "number of the shape code"))
    return _svg(title, width, height, shapes)


def _axes(width: int, height: int, left: int, bottom: int, y_end: float, unit: str) -> str:
    lines = []
    for share in (0.0, 0.5, 1.0):
        y = (height - bottom) * (1 - share / 1.1)
        lines.append(f'<line x1="{left}" x2="{width - 8}" y1="{y:.1f}" y2="{y:.1f}" stroke="#e6e8ec"/>')
        lines.append(_text(left - 4, y + 3, f"{share * y_end / 1.1:.1f}", "end"))
    lines.append(_text(2, 9, unit, "start"))
    return "".join(lines)


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="9" fill="{FAINT}" text-anchor="{anchor}">{text}</text>'


def _svg(title: str, width: int, height: int, shapes: Sequence[str]) -> str:
    return (
        f'<div style="{_FONT};padding:0 0.75em"><div style="font-size:0.85em;font-weight:600">{escape(title)}'
        f'</div><svg viewBox="0 0 {width} {height}" width="100%">{"".join(shapes)}</svg></div>'
    )
