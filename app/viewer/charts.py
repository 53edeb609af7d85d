"""Charts of the panel as HTML and SVG: stages, object table, curves, bars. All text is escaped here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from app.drawing import CLASS_COLORS
from app.viewer.snapshot import TASK_STAGES, ObjectOutcome, ObjectState, StageSpan
from perception.types import CATEGORIES, Category, ObjectEstimate

INK, FAINT, ACCENT, GOOD, BAD = "#22252b", "#7a7f8a", "#1f6fd0", "#1b7f5c", "#c23b22"
PENDING = "#d5d8de"
_FONT = "font-family:Inter,system-ui,sans-serif"
_MIN_BAR_RANGE = 2.5  # standard deviations of the prior


@dataclass(frozen=True)
class Curve:
    """A polyline in the colour of a class."""

    x: Sequence[float]
    y: Sequence[float]
    category: Category


@dataclass(frozen=True)
class _Plot:
    """Size of an SVG image, and its margins for the labels of the axes."""

    width: int
    height: int
    left: int = 34
    bottom: int = 20

    @property
    def base(self) -> int:
        """Vertical position of the lower axis."""
        return self.height - self.bottom

    @property
    def center(self) -> float:
        """Horizontal centre of the plotted area."""
        return self.left + (self.width - self.left) / 2


_CURVES, _BARS = _Plot(340, 150), _Plot(340, 120)


def css(color: tuple[int, int, int]) -> str:
    """Return an RGB colour as ``#rrggbb``."""
    return "#" + "".join(f"{value:02x}" for value in color)


def header(title: str, subtitle: str) -> str:
    """Return a title with a subtitle."""
    return (
        f'<div style="{_FONT};padding:0 0.75em"><div style="font-size:1.15em;font-weight:650">'
        f'{escape(title)}</div><div style="color:{FAINT};font-size:0.85em">{escape(subtitle)}</div></div>'
    )


def stage_bar(
    stages: Sequence[StageSpan], now: float, caption: str, titles: Mapping[str, str] = TASK_STAGES
) -> str:
    """Return the row of stages above a caption.

    Args:
        stages: Stages begun so far.
        now: Show time in seconds; earlier stages are marked as done, later ones as pending.
        caption: Description of the current action.
        titles: Titles of all stages by name, in order.
    """
    spans = {span.name: span for span in stages}
    current = next((span.name for span in reversed(stages) if span.begin <= now), "")
    names = list(titles)
    reached = names.index(current) if current in names else -1
    cells = []
    for index, (name, title) in enumerate(titles.items()):
        span = spans.get(name)
        duration = f"{span.seconds:.0f} s" if span is not None and span.seconds is not None else "&nbsp;"
        color = GOOD if index < reached else ACCENT if index == reached else PENDING
        weight = 650 if index == reached else 450
        cells.append(
            f'<div style="flex:1 1 auto;text-align:center">'
            f'<div style="height:5px;border-radius:3px;background:{color};margin-bottom:3px"></div>'
            f'<div style="font-size:0.72em;font-weight:{weight}">'
            f'{escape(title)}</div><div style="font-size:0.66em;color:{FAINT}">{duration}</div></div>'
        )
    return (
        f'<div style="{_FONT};padding:0 0.75em"><div style="display:flex;gap:4px">{"".join(cells)}</div>'
        f'<div style="margin-top:4px;min-height:2.6em;line-height:1.3;font-size:0.85em">'
        f"{escape(caption)}</div></div>"
    )


def object_table(
    objects: Mapping[int, ObjectState],
    estimates: Sequence[ObjectEstimate],
    outcomes: Mapping[int, ObjectOutcome],
) -> str:
    """Return a table with class, size, score and status of each object.

    Args:
        objects: Object states by id.
        estimates: The object map.
        outcomes: Outcomes in the report by id.
    """
    known = {estimate.id: estimate for estimate in estimates}
    rows = []
    for id, state in sorted(objects.items()):
        estimate = known.get(id)
        details = f"iteration {state.iteration}" if state.iteration is not None else ""
        if estimate is not None and state.iteration is None:
            details = (
                f"{200 * estimate.radius:.1f} × {100 * estimate.height:.1f} cm · "
                f"score {estimate.score:.2f} · {estimate.n_views} views"
            )
        if state.residual is not None:
            details += f" · residual {1000 * state.residual:.1f} mm"
        status, color = _status(state, outcomes.get(id))
        rows.append(
            f'<div style="display:flex;gap:0.6em;padding:0.45em 0;border-top:1px solid #e6e8ec">'
            f'<div style="width:0.8em;height:0.8em;border-radius:50%;margin-top:0.25em;flex:none;'
            f'background:{css(CLASS_COLORS[state.category])}"></div><div style="min-width:0">'
            f"<b>{escape(state.name.replace('_', ' '))}</b> "
            f'<span style="color:{color}">{escape(status)}</span>'
            f'<div style="color:{FAINT};font-size:0.85em">{escape(details)}</div></div></div>'
        )
    content = "".join(rows) or f'<div style="color:{FAINT}">No object detected yet.</div>'
    return f'<div style="{_FONT};padding:0 0.75em;font-size:0.9em">{content}</div>'


def _status(state: ObjectState, outcome: ObjectOutcome | None) -> tuple[str, str]:
    """Return the status as text, and its colour."""
    if state.status == "placed" and outcome is not None and outcome.placed:
        error = outcome.error_position
        return f"in place, {1000 * error:.0f} mm from plan" if error is not None else "in place", GOOD
    if state.status == "not placed":
        return state.reason or "not placed", BAD
    return state.status, ACCENT if state.status in ("fitting", "next", "held") else FAINT


def note(text: str) -> str:
    """Return a line of small text."""
    return f'<div style="{_FONT};padding:0 0.75em;color:{FAINT};font-size:0.85em">{escape(text)}</div>'


def legend() -> str:
    """Return the legend of the class colours."""
    entries = "".join(
        f'<span style="margin-right:0.9em;white-space:nowrap"><span style="display:inline-block;width:0.8em;'
        f'height:0.8em;border-radius:50%;background:{css(CLASS_COLORS[category])}"></span> {category}</span>'
        for category in CATEGORIES
    )
    return f'<div style="{_FONT};padding:0 0.75em;font-size:0.85em">{entries}</div>'


def color_scale(low: str, high: str, colors: Sequence[tuple[int, int, int]]) -> str:
    """Return a colour bar between two labels."""
    return (
        f'<div style="{_FONT};padding:0 0.75em;font-size:0.85em;display:flex;gap:0.6em;align-items:center">'
        f'{escape(low)}<span style="flex:1;height:0.7em;border-radius:0.35em;background:'
        f'linear-gradient(to right,{",".join(css(color) for color in colors)})"></span>{escape(high)}</div>'
    )


def curves(title: str, lines: Mapping[str, Curve], unit: str) -> str:
    """Return a plot of curves over optimiser iterations, by name; ``unit`` labels the vertical axis."""
    plot = _CURVES
    xs = [x for line in lines.values() for x in line.x]
    ys = [y for line in lines.values() for y in line.y]
    x_end, y_end = max([*xs, 1.0]), 1.1 * max([*ys, 1e-9])
    shapes = [_axes(plot, y_end, unit)]
    for name, line in lines.items():
        points = [
            (plot.left + (plot.width - plot.left - 46) * x / x_end, plot.base * (1 - y / y_end))
            for x, y in zip(line.x, line.y, strict=True)
        ]
        if not points:
            continue
        path = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
        color = css(CLASS_COLORS[line.category])
        shapes.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        a, b = points[-1]
        shapes.append(
            f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="{color}"/><text x="{a + 5:.1f}" y="{b + 3:.1f}" '
            f'font-size="9" fill="{INK}">{escape(name.replace("_", " "))}</text>'
        )
    if not xs:
        shapes.append(_text(plot.center, plot.height / 2 - 16, "no fit yet"))
    shapes.append(_text(plot.center, plot.height - 4, "iteration of the optimiser"))
    return _svg(title, plot, shapes)


def bars(title: str, values: Sequence[float], category: Category) -> str:
    """Return a bar chart of the components of a shape code, whose prior is a standard normal distribution."""
    plot = _BARS
    span = max(_MIN_BAR_RANGE, float(np.abs(values).max()) * 1.1 if len(values) else 0.0)
    middle = plot.base / 2
    shapes = [
        f'<line x1="{plot.left}" x2="{plot.width - 8}" y1="{middle}" y2="{middle}" stroke="#b9bec8"/>',
        _text(plot.left - 4, middle + 3, "0", "end"),
        _text(plot.left - 4, 9, f"{span:.1f}", "end"),
    ]
    step = (plot.width - plot.left - 8) / max(len(values), 1)
    for index, value in enumerate(values):
        size = middle * abs(value) / span
        top = middle - size if value > 0 else middle
        shapes.append(
            f'<rect x="{plot.left + step * index + 2:.1f}" y="{top:.1f}" width="{step - 4:.1f}" '
            f'height="{size:.1f}" rx="1.5" fill="{css(CLASS_COLORS[category])}"/>'
        )
    if not np.any(values):
        shapes.append(_text(plot.center, middle - 16, "no shape code"))
    shapes.append(_text(plot.center, plot.height - 4, "component of the shape code"))
    return _svg(title, plot, shapes)


def _axes(plot: _Plot, y_end: float, unit: str) -> str:
    lines = []
    for share in (0.0, 0.5, 1.0):
        y = plot.base * (1 - share / 1.1)
        lines.append(
            f'<line x1="{plot.left}" x2="{plot.width - 8}" y1="{y:.1f}" y2="{y:.1f}" stroke="#e6e8ec"/>'
        )
        lines.append(_text(plot.left - 4, y + 3, f"{share * y_end / 1.1:.1f}", "end"))
    lines.append(_text(2, 9, unit, "start"))
    return "".join(lines)


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="9" fill="{FAINT}" text-anchor="{anchor}">'
        f"{escape(text)}</text>"
    )


def _svg(title: str, plot: _Plot, shapes: Sequence[str]) -> str:
    return (
        f'<div style="{_FONT};padding:0 0.75em"><div style="font-size:0.85em;font-weight:600">{escape(title)}'
        f'</div><svg viewBox="0 0 {plot.width} {plot.height}" width="100%">{"".join(shapes)}</svg></div>'
    )
