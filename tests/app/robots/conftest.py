"""The small arms of the simulator's tests, as files."""

import pytest

from tests.sim_assets.robots.conftest import SLIDING, linkage


@pytest.fixture(params=[SLIDING, linkage()], ids=["sliding", "linkage"])
def arm_file(request, tmp_path):
    path = tmp_path / "models" / "arm.xml"
    path.parent.mkdir()
    path.write_text(request.param)
    return path
