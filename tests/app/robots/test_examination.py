"""The simulated tests of an arm; those without simulation have tests of their own."""

import pytest

from app.robots import examination
from app.robots.examination import check_payload
from sim_assets.cell.world import World
from sim_assets.robots import load_robot


@pytest.mark.parametrize(("load", "verdict"), [(2.0, "good"), (0.2, "warning")])
def test_payload_against_the_heaviest_objects(monkeypatch, load, verdict):
    monkeypatch.setattr(examination, "payload", lambda world: load)
    finding = check_payload(object.__new__(World))
    assert finding.verdict == verdict and f"{load:.1f} kg" in finding.found


@pytest.mark.slow
def test_the_shipped_panda_has_no_faults():
    found = examination.examine_robot(load_robot("panda"))
    assert not [f for f in found.findings if f.verdict == "fault"], found.findings
    assert found.reach[-1] > 0.7 and found.fit.workspace.scale == 1.0
