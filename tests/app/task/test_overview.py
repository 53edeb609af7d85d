from dataclasses import replace

import numpy as np
from PIL import Image

from app.runs.report import ObjectReport
from app.task.overview import Overview, _seen, write_overview
from perception.detection.left_out import LeftOut
from perception.pipeline import Detections
from perception.support.surface import SupportSurface
from perception.types import ObjectDetection, SupportPlane


def test_complete_and_partial_overviews_are_written(tmp_path, overhead_frame, can_at, pack_plan):
    mask = np.zeros((120, 160), bool)
    mask[50:70, 70:90] = True
    found = Detections(SupportPlane(), ((ObjectDetection("can", 0.8, mask, instance_id=0),),))
    scene = np.zeros((72, 96, 3), np.uint8)
    reports = [
        ObjectReport(0, "can", True, 0.001, 0.0, 1),
        ObjectReport(-1, "mug", False, reason="not perceived " * 9),
    ]
    complete = Overview(
        "Pack", "seed 1", scene, scene, scene, [overhead_frame], found, [can_at()], pack_plan, reports
    )
    unplanned = replace(pack_plan, left_out={"bowl_3": "it stands upside down"})
    overviews = {
        "complete": complete,
        "unplanned": replace(complete, plan=unplanned),
        "empty": Overview("Pack", "stopped early"),
    }
    for name, overview in overviews.items():
        write_overview(tmp_path / f"{name}.png", overview)
        with Image.open(tmp_path / f"{name}.png") as image:
            assert min(image.size) > 1000
    assert (tmp_path / "complete.png").stat().st_size > (tmp_path / "empty.png").stat().st_size


def test_the_surface_and_what_is_left_out_are_drawn(overhead_frame):
    mask = np.zeros((120, 160), bool)
    mask[50:70, 70:90] = True
    square = np.array([[0.3, -0.3], [0.5, -0.3], [0.5, -0.1], [0.3, -0.1]])
    surface, candidate = SupportSurface(SupportPlane(), square), LeftOut(mask, "no depth")
    found = Detections(SupportPlane(), ((),), (surface,), (candidate,))
    image = _seen(overhead_frame, 0, found)
    assert (image[50, 72:88] != overhead_frame.rgb[50, 72:88]).any()
    outlined = (image != _seen(overhead_frame, 0, Detections(SupportPlane(), ((),), (), (candidate,)))).any(
        -1
    )
    assert outlined.sum() > 150
    elsewhere = Detections(SupportPlane(), ((), ()), (), (LeftOut(mask, "no depth", frame=1),))
    np.testing.assert_array_equal(_seen(overhead_frame, 0, elsewhere), overhead_frame.rgb)
    np.testing.assert_array_equal(_seen(overhead_frame, 0, None), overhead_frame.rgb)
