"""Every kind: a finite mesh of its size, outward surfaces, few triangles, textured, repeatable."""

import pytest

from sim_assets.datasets.distractors import workshop


@pytest.mark.parametrize("kind", dict.fromkeys(workshop.KINDS))
def test_kind(kind, check_kind):
    check_kind(kind, largest=0.5)
