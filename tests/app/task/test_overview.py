import numpy as np
from PIL import Image

from app.runs.report import ObjectReport
from app.task.overview import Overview, write_overview
from perception.pipeline import Detections
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
    for name, overview in {"complete": complete, "empty": Overview("Pack", "stopped early")}.items():
        write_overview(tmp_path / f"{name}.png", overview)
        with Image.open(tmp_path / f"{name}.png") as image:
            assert min(image.size) > 1000
    assert (tmp_path / "complete.png").stat().st_size > (tmp_path / "empty.png").stat().st_size
