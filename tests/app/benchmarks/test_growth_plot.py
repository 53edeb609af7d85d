"""The plot of growth curves."""

import xml.etree.ElementTree as ET

from app.benchmarks.growth_plot import svg_of, time_of

CURVES = [
    {"name": "fit", "parameter": "objects", "points": [{"at": 1, "seconds": 9.0, "core_seconds": 1.0}]},
    {"name": "episode", "parameter": "workers", "points": [{"at": 2, "seconds": 9.0, "core_seconds": None}]},
]


def test_the_plot_has_one_panel_for_each_parameter():
    text = svg_of(CURVES).decode()
    ET.fromstring(text)
    assert text.count('id="axes_') == 2
    for label in ("fit", "episode", "objects", "workers"):
        assert f">{label}<" in text
    assert ">views<" not in text


def test_the_same_curves_give_the_same_file():
    assert svg_of(CURVES) == svg_of(CURVES)


def test_processor_time_is_preferred():
    assert [time_of(curve["points"][0]) for curve in CURVES] == [1.0, 9.0]
