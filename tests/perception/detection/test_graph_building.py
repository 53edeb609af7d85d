"""The shipped graphs are those of the present architecture, and hold no weights."""

import pytest

pytest.importorskip("onnx")

from perception.detection.graph_building import graphs, write_graphs
from perception.detection.graph_predictors import GRAPHS_DIRECTORY


def test_the_shipped_graphs_are_up_to_date():
    built = graphs()
    assert {path.name for path in GRAPHS_DIRECTORY.iterdir()} == built.keys()
    for name, content in built.items():
        assert (GRAPHS_DIRECTORY / name).read_bytes() == content, (
            f"{name}: run `python -m perception.detection.graph_building`"
        )


def test_graphs_are_written_without_weights(tmp_path):
    write_graphs(tmp_path / "graphs")
    sizes = {path.name: path.stat().st_size for path in (tmp_path / "graphs").iterdir()}
    assert sizes.keys() == graphs().keys() and max(sizes.values()) < 20_000
