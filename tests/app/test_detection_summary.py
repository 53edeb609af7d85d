"""Words for what detection saw."""

import numpy as np

from app.detection_summary import left_out_as_json, surface_text, surfaces_as_json, why_nothing
from perception.detection.left_out import LeftOut
from perception.pipeline import Detections
from perception.support.surface import SupportSurface
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane

LENS = CameraIntrinsics(8, 6, 9.0, 9.0, 3.5, 2.5)
FRAME = RgbdFrame(0.0, np.zeros((6, 8, 3), np.uint8), np.ones((6, 8), np.float32), LENS)
PLANE = SupportPlane(np.array([0.0, 0.0, -1.0]), -0.65)
TABLE = SupportSurface(PLANE, np.array([[0.0, 0.0], [0.9, 0.0], [0.9, 0.6], [0.0, 0.6]]))
MASK = np.zeros((6, 8), bool)
MASK[2:4, 1:6] = True


def test_a_surface_has_size_and_distance():
    assert surface_text(TABLE, FRAME) == "support surface of 0.90 x 0.60 m, 0.65 m below the camera"
    unknown = SupportSurface(PLANE)
    assert surface_text(unknown, FRAME) == "support surface of unknown extent, 0.65 m below the camera"


def test_nothing_found_is_explained():
    left_out = (LeftOut(MASK, "too far", "2.4 m"), LeftOut(MASK, "no depth"))
    assert why_nothing(Detections(PLANE, ((),), (TABLE,), left_out), [FRAME]) == (
        "no object was found (support surface of 0.90 x 0.60 m, 0.65 m below the camera): "
        "1 left out: too far (2.4 m); 1 left out: no depth"
    )
    assert why_nothing(Detections(PLANE, ((),)), [FRAME]) == "no object was found: no candidate was seen"


def test_the_report_has_plain_values():
    (surface,) = surfaces_as_json([TABLE])
    assert surface["normal"] == [0.0, 0.0, -1.0] and surface["offset"] == -0.65
    np.testing.assert_allclose(np.array(surface["outline"])[:, 2], 0.65)
    (candidate,) = left_out_as_json([LeftOut(MASK, "no depth", frame=3)])
    assert candidate == {"image": 3, "reason": "no depth", "detail": "", "box": [1, 2, 5, 2]}
