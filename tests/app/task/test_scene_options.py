"""Scene options: defaults change nothing, values are checked, --clutter is a mixture."""

import numpy as np
import pytest

from app.errors import UsageError
from app.options import EvaluateOptions, PackOptions
from app.task.scene_options import (
    camera_error,
    check_scene,
    counts,
    friction,
    region_limits,
    scene_settings,
    view_counts,
)
from sim_assets.cell.arrangement import Arrangement

SEED = np.random.SeedSequence(0)


def test_defaults_leave_the_cell_as_it_is():
    settings = scene_settings(PackOptions(), 6, SEED)
    assert settings == {
        "arrangement": Arrangement(), "unknown": (), "camera_error": (0.0, 0.0), "friction": None
    }  # fmt: skip


def test_units_are_converted():
    assert camera_error(PackOptions(camera_error="3,0.5")) == pytest.approx((0.003, np.deg2rad(0.5)))
    assert friction(PackOptions(friction="0.35, 1.0")) == (0.35, 1.0)
    assert region_limits(PackOptions(region="0.3,0.5,-0.4,-0.1")) == ((0.3, 0.5), (-0.4, -0.1))


def test_clutter_is_a_mixture_and_single_options_take_precedence():
    expected = {"lying": 2, "upside_down": 1, "stacked": 2, "unknown": 3}
    assert counts(PackOptions(clutter=True), 8) == expected
    assert counts(PackOptions(clutter=True, lying=4), 8) == expected | {"lying": 4, "stacked": 1}
    for n in range(1, 21):  # a stack takes two of the objects that rest on their base
        mixture = counts(PackOptions(clutter=True), n)
        assert mixture["lying"] + mixture["upside_down"] + 2 * mixture["stacked"] <= n
    assert counts(PackOptions(clutter=True, stacked=2), 6)["stacked"] == 2
    settings = scene_settings(PackOptions(clutter=True), 8, SEED)
    assert settings["drawn_together"] and settings["min_gap"] == 0.0 and len(settings["unknown"]) == 3
    assert scene_settings(PackOptions(clutter=True, gap=0.01), 8, SEED)["min_gap"] == 0.01


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lying": -1}, "--lying -1 must be in 0..20"),
        ({"upside_down": 21}, "--upside-down 21 must be in"),
        ({"unknown": 9}, "--unknown 9 must be in 0..8"),
        ({"gap": -0.01}, "--gap -0.01 m must be in 0..0.2 m"),
        ({"gap": float("nan")}, "--gap nan m must be in"),
        ({"camera_error": "3"}, "--camera-error takes MM,DEG such as 3,0.5, not '3'"),
        ({"camera_error": "3,90"}, "--camera-error 90 deg must be in 0..10 deg"),
        ({"friction": "1.0,0.5"}, "--friction 1.0,0.5 must be ascending in 0.05..2"),
        ({"region": "0,1,0"}, "--region takes X0,X1,Y0,Y1"),
        (
            {"region": "0.5,0.3,-0.4,-0.1"},
            "--region 0.5,0.3,-0.4,-0.1 must be ascending ranges in x 0.2..0.8",
        ),
    ],
)
def test_impossible_values_are_refused(options, message):
    with pytest.raises(UsageError) as error:
        check_scene(PackOptions(**options))
    assert message in str(error.value)
    with pytest.raises(UsageError):
        check_scene(EvaluateOptions(what="tasks", **options))


@pytest.mark.parametrize(
    "options", [PackOptions(scan_views=0), EvaluateOptions(what="tasks", scan_views="0")]
)
def test_a_scan_has_at_least_one_image(options):
    with pytest.raises(UsageError, match=r"^--scan-views 0 must be in 1..6$"):
        check_scene(options)


def test_several_numbers_of_images_are_compared():
    assert view_counts(4) == (4,) and view_counts("1, 2,6") == (1, 2, 6)
    for text, problem in {
        "1,7": "must be in",
        "1,,2": "must be in",
        "-1": "must be in",
        "2,2": "different",
    }.items():
        with pytest.raises(UsageError, match=problem):
            view_counts(text)
