"""Which cells an evaluation compares, and the options of their episodes."""

from pathlib import Path

import pytest

from app.errors import UsageError
from app.evaluation.cells import Cell, cells_of, episode_options
from app.options import EvaluateOptions, TaskOptions


def options(**changes):
    return EvaluateOptions(what="tasks", **changes)


def test_an_evaluation_has_one_cell_unless_asked_for_more():
    assert cells_of(options()) == (Cell("nodeslam", 6, "on"),)
    assert cells_of(options(shapes=("tsdf",), scan_views="3")) == (Cell("tsdf", 3, "on"),)


def test_all_combinations_that_differ_in_effect_are_cells():
    cells = cells_of(
        options(shapes=("nodeslam", "tsdf", "oracle"), scan_views="1,6", uncertainty=("on", "off"))
    )
    assert [cell.name for cell in cells] == [
        "nodeslam, 1 view", "nodeslam, 1 view, uncertainty off",
        "nodeslam, 6 views", "nodeslam, 6 views, uncertainty off",
        "tsdf, 1 view", "tsdf, 6 views", "oracle, 6 views",
    ]  # fmt: skip
    assert len({cell.key(3) for cell in cells}) == 7


@pytest.mark.parametrize("changes, message", [
    ({"shapes": ("tsdf", "tsdf")}, "--shapes tsdf tsdf takes different values"),
    ({"uncertainty": ()}, "--uncertainty  takes different values"),
    ({"scan_views": "1,1"}, "--scan-views 1,1 takes different numbers"),
    ({"scan_views": "1,x"}, "--scan-views 1,x must be in 1..6"),
])  # fmt: skip
def test_values_given_twice_are_refused(changes, message):
    with pytest.raises(UsageError, match=f"^{message}"):
        cells_of(options(**changes))


def test_an_episode_has_the_options_of_the_evaluation_and_of_its_cell():
    whole = options(objects="mug=2", clutter=True, out=Path("x"), seed=4, shapes=("tsdf", "oracle"))
    episode = episode_options(Cell("tsdf", 3, "off").of(whole), 17)
    assert type(episode) is TaskOptions
    assert (episode.objects, episode.clutter, episode.seed, episode.out) == ("mug=2", True, 17, Path("x"))
    assert (episode.shapes, episode.scan_views, episode.uncertainty) == ("tsdf", 3, "off")
