import pytest

from app.evaluation.statistics import kind_of, paired_difference, summarise, wilson_interval


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        # Newcombe, Statistics in Medicine 17 (1998), table I, method 3.
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
        (20, 20, 0.8389, 1.0000),
    ],
)
def test_wilson_interval_agrees_with_published_values(successes, trials, low, high):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)


def test_wilson_interval_at_the_border():
    assert wilson_interval(0, 0) == (0.0, 1.0)
    with pytest.raises(ValueError, match="3 successes of 2 trials"):
        wilson_interval(3, 2)


def test_reasons_are_joined_by_kind():
    first = "mug_3 at (0.61, -0.44) m is out of the arm's reach; move it closer"
    second = "mug_12 at (0.30, -0.05) m is out of the arm's reach; move it closer"
    assert kind_of(first) == kind_of(second) == "it at m is out of the arm's reach; move it closer"
    assert kind_of("tilted by 12 deg") == "tilted by N deg"
    assert kind_of("74 without a release (collide with wall (hand)), 2") == "N without a release, N"


def thing(category, placed, reason=""):
    return {"category": category, "placed": placed, "reason": reason}


def test_summary_of_three_episodes():
    row = {"category": "mug", "found": True, "accuracy": 0.002, "handle_recall": 0.7}
    lines = [
        {
            "seed": 1,
            "success": True,
            "reason": "",
            "objects": [thing("mug", True), thing("can", True)],
            "metrics": {"simulated_seconds": 40.0, "reconstruction": [row, row | {"accuracy": 0.004}]},
            "timings": {"scan": 4.0},
            "wall_seconds": 70.0,
        },
        {
            "seed": 2,
            "success": False,
            "reason": "1 of 2",
            "objects": [thing("mug", False, "tilted by 12 deg"), thing("can", True)],
            "metrics": {
                "simulated_seconds": 50.0,
                "reconstruction": [row | {"found": False, "accuracy": None}],
            },
            "timings": {"scan": 6.0},
            "wall_seconds": 90.0,
        },
        {"seed": 3, "success": False, "reason": "crashed: ValueError: 7", "objects": [], "wall_seconds": 1.0},
    ]
    summary = summarise(lines)
    assert (summary["n_episodes"], summary["n_successes"], summary["n_objects"]) == (3, 1, 4)
    assert summary["success_rate"] == pytest.approx(1 / 3) and summary["object_success_rate"] == 0.75
    assert summary["success_rate_ci"] == wilson_interval(1, 3)
    assert summary["n_placed"] == 3 and summary["object_success_rate_ci"] == wilson_interval(3, 4)
    assert summary["per_class"]["mug"]["success_rate_ci"] == wilson_interval(1, 2)
    assert summary["wall_seconds"] == 70.0  # the median of 1, 70 and 90
    assert summary["per_class"]["mug"]["success_rate"] == 0.5
    assert summary["failures"] == {"mug: tilted by N deg": 1, "crashed: ValueError: N": 1}
    assert summary["simulated_seconds"] == 45.0 and summary["stage_seconds"] == {"scan": 5.0}
    mugs = summary["reconstruction"]["mug"]
    assert mugs["accuracy"] == pytest.approx(0.003) and mugs["found"] == pytest.approx(2 / 3)


def test_perception_is_summarised_by_how_objects_rest():
    right = {
        "category": "can", "perceived": "can", "resting": "lying", "stacked": False, "found": True,
        "axis_error": 0.1, "chamfer_l1": 0.002, "completion": 1.0,
    }  # fmt: skip
    rows = [
        right,
        right | {"perceived": "bottle", "chamfer_l1": 0.9},
        right | {"axis_error": 3.1, "chamfer_l1": 0.9},
        {"category": "can", "resting": "lying", "stacked": False, "found": False},
        right | {"resting": "upright", "stacked": True, "chamfer_l1": 0.004},
    ]
    line = {"success": False, "reason": "", "objects": [], "metrics": {"reconstruction": rows}}
    assert summarise([line])["resting"] == {
        "lying": {
            "n": 4, "found": 0.75, "named": 0.5, "right": 0.25, "chamfer_l1": 0.002, "completion": 1.0
        },
        "on another": {
            "n": 1, "found": 1.0, "named": 1.0, "right": 1.0, "chamfer_l1": 0.004, "completion": 1.0
        },
    }  # fmt: skip


def test_paired_differences_are_over_what_both_have():
    first, second = {0: 1.0, 1: 2.0, 2: 3.0}, {0: 2.0, 1: 4.0, 9: 0.0}
    found = paired_difference(first, second)
    half = 12.706204736 * 0.5  # Student's quantile of one degree of freedom, times the mean's error
    assert found == pytest.approx({"mean": 1.5, "low": 1.5 - half, "high": 1.5 + half, "n": 2})
    assert paired_difference(first, {0: 1.0}) == {"mean": None, "low": None, "high": None, "n": 1}


def test_faults_are_counted_by_kind_where_they_occurred():
    def line(kind, number, complete, reported=True, lost=False, reason=""):
        fault = {"kind": kind, "object": number, "complete": complete, "reported": reported, "lost": lost}
        metrics = {"fault": fault, "simulated_seconds": 40.0}
        return {"success": complete, "objects": [], "reason": reason, "metrics": metrics}

    lines = [
        line("slip", 1, True),
        line("slip", 0, False, reported=False, reason="can 3: toppled"),
        line("take-away", 2, True, lost=True),
        line("move", None, True),
        {"success": True, "objects": [], "reason": ""},
    ]
    faults = summarise(lines)["faults"]
    assert list(faults) == ["slip", "take-away"]
    slip = faults["slip"]
    assert (slip["n_episodes"], slip["n_complete"], slip["n_reported"], slip["n_lost"]) == (2, 1, 0, 0)
    assert slip["complete_rate"] == 0.5 and slip["reasons"] == {"can N: toppled": 1}
    assert faults["take-away"]["n_lost"] == 1 and faults["take-away"]["n_complete"] == 1


def test_things_of_no_class_that_were_moved_are_counted():
    def line(*shifts):
        things = [{"shift": s, "moved": s > 0.005, "toppled": s > 0.1} for s in shifts]
        return {"success": True, "objects": [], "reason": "", "metrics": {"unknown": things}}

    counted = summarise([line(0.001, 0.02), line(0.3)])["unknown"]
    assert counted == {"n_things": 3, "n_moved": 2, "n_toppled": 1, "largest_shift": 0.3}
    assert summarise([])["unknown"]["largest_shift"] is None
