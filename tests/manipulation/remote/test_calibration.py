import datetime

import numpy as np
import pytest

from manipulation.remote.calibration import CalibrationError, read_hand_eye

GOOD = """
T_tcp_camera = [[0.0, -1.0, 0.0, 0.065], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -0.051], [0.0, 0.0, 0.0, 1.0]]
residual_position = 0.0008
residual_rotation = 0.003
calibrated = 2026-11-20
"""


def test_a_calibration_is_read(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text(GOOD)
    hand_eye = read_hand_eye(path)
    np.testing.assert_array_equal(hand_eye.T_tcp_camera[:3, 3], (0.065, 0.0, -0.051))
    assert hand_eye.calibrated == datetime.date(2026, 11, 20) and hand_eye.residual_position == 0.0008


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0.0, -1.0, 0.0, 0.065", "0.0, -2.0, 0.0, 0.065", "rigid motion"),
        ("0.0, -1.0, 0.0, 0.065", "0.0, nan, 0.0, 0.065", "finite"),
        (
            "0.0, -1.0, 0.0, 0.065",
            "0.0, -1.0, 0.0, 65.0",
            "the camera is 65 m from the tool .* give metres",
        ),
        ("0.0, -1.0, 0.0, 0.065", "0.0, -1.0, 0.0", "length"),
        ("residual_position = 0.0008", "residual_position = 0.02", r"20\.0 mm .* calibrate again"),
        ("residual_rotation = 0.003", "residual_rotation = -1.0", ">= 0"),
        ("residual_rotation = 0.003", "", "missing required field `residual_rotation`"),
        ("calibrated", "made", "unknown field `made`"),
        ("2026-11-20", "'soon'", "RFC3339|date"),
        ("[[0.0", "[[[0.0", "Unclosed|Invalid"),
        ("residual_rotation = 0.003", "residual_rotation = nan", ">= 0"),
        ("0.0008", 5000 * "1", "digits"),
    ],
)
def test_each_fault_is_one_line_with_the_file(tmp_path, old, new, message):
    path = tmp_path / "camera.toml"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(CalibrationError, match=message) as caught:
        read_hand_eye(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CalibrationError, match="give the file of a hand-eye calibration"):
        read_hand_eye(tmp_path / "none.toml")


def test_a_file_in_another_encoding_is_named(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_bytes(GOOD.encode("utf-16"))
    with pytest.raises(CalibrationError, match="can't decode"):
        read_hand_eye(path)
