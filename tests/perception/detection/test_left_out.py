"""Wording of the candidates that are left out."""

import numpy as np

from perception.detection.left_out import LeftOut, of_no_class, summarise

MASK = np.zeros((20, 30), bool)
MASK[8:12, 10:15] = True


def test_the_text_is_reason_and_figure():
    assert LeftOut(MASK, "no depth").text == "no depth"
    assert LeftOut(MASK, "too far", "2.4 m").text == "too far (2.4 m)"


def test_a_candidate_of_no_class_says_whether_the_image_cuts_it():
    assert of_no_class(MASK, 0.931).text == "of none of the classes (p = 0.93)"
    cut = np.roll(MASK, -10, axis=1)
    assert of_no_class(cut, 0.5, 3).detail == "p = 0.50, cut by the image border"
    assert of_no_class(cut, 0.5, 3).frame == 3


def test_the_summary_has_one_line_for_each_reason():
    left_out = [LeftOut(MASK, "no depth")]
    left_out += [LeftOut(MASK, "too far", f"{k} m", frame=k % 2) for k in range(5)]
    assert summarise(left_out[:2], 1) == ["1 left out: no depth", "1 left out: too far (0 m)"]
    assert summarise(left_out, 4) == [
        "5 left out in 2 of 4 images: too far (0 m, 1 m, 2 m, ...)",
        "1 left out in 1 of 4 images: no depth",
    ]
    assert summarise([], 1) == []
