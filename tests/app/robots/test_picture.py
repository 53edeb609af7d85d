"""``robot.png`` is written and shows something in each quarter."""

import numpy as np
import PIL.Image
import pytest

from app.robots.examination import Examination
from app.robots.picture import write_picture
from manipulation.workspace import ReachFit, Workspace
from sim_assets.robots import load_robot


@pytest.mark.slow
def test_picture(tmp_path):
    found = Examination((), np.array([0.3, 0.7]), ReachFit(Workspace(), 1.0))
    write_picture(tmp_path / "robot.png", load_robot("sixaxis"), found)
    image = np.asarray(PIL.Image.open(tmp_path / "robot.png").convert("L"))
    h, w = image.shape[0] // 2, image.shape[1] // 2
    assert all(quarter.std() > 5 for quarter in (image[:h, :w], image[:h, w:], image[h:, :w], image[h:, w:]))
