"""Growth curves as one SVG image, with one panel for each parameter."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

PANELS = ("objects", "views", "landmarks", "workers")


def svg_of(curves: Sequence[Mapping[str, Any]]) -> bytes:
    """Return the plot of curves in the form of ``report.json``; the same curves give the same bytes.

    Processor times are drawn where they are known, wall times elsewhere, both axes logarithmic.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    names = [name for name in PANELS if any(curve["parameter"] == name for curve in curves)]
    with rc_context({"svg.hashsalt": "nodeslam", "svg.fonttype": "none", "font.size": 8}):
        figure = Figure(figsize=(3.0 * len(names), 2.6), layout="constrained")
        for axes, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
            _draw(axes, [curve for curve in curves if curve["parameter"] == name])
            axes.set_xlabel(name)
            axes.legend(frameon=False, fontsize=6)
        figure.axes[0].set_ylabel("time [ms]")
        file = io.BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()


def _draw(axes: Any, curves: Sequence[Mapping[str, Any]]) -> None:
    """Draw the curves of one parameter, with ticks at its values and at 1, 2, 5 of each decade of times."""
    from matplotlib.ticker import LogLocator

    axes.set_xscale("log")
    axes.set_yscale("log")
    for curve in curves:
        times = [1e3 * time_of(point) for point in curve["points"]]
        axes.plot([point["at"] for point in curve["points"]], times, marker="o", ms=3, label=curve["name"])
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    at = sorted({point["at"] for curve in curves for point in curve["points"]})
    axes.set_xticks(at, [str(x) for x in at])
    axes.minorticks_off()
    axes.grid(alpha=0.3)


def time_of(point: Mapping[str, Any]) -> float:
    """Return the processor time of a point if it is known, else its wall time, in seconds."""
    core = point["core_seconds"]
    return point["seconds"] if core is None else core
