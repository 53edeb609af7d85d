"""Configurations of the compared methods."""

import pytest

from perception.inference import ablations
from perception.inference.ablations import METHODS, method_config, reconstruct_by
from perception.inference.fit_config import FitConfig
from perception.types import SupportPlane

BASE = FitConfig(start_views=1)


@pytest.mark.parametrize("method", [m for m in METHODS if m != "tsdf"])
def test_every_method_differs_from_the_product_and_keeps_its_budget(method) -> None:
    config = method_config(method, BASE)
    assert (config == BASE) == (method == "full")
    assert sum(stage.iterations for stage in config.stages) == 30 and config.start_views == 1


def test_what_each_method_leaves_out() -> None:
    assert method_config("no_refinement").refine is None
    uncertain = method_config("no_uncertainty")
    assert not uncertain.noise.rendered_variance and uncertain.refine == FitConfig().refine
    assert {(s.crop, s.level) for s in method_config("no_pyramid").stages} == {(64, 0)}
    dvr, mask_only = method_config("dvr"), method_config("mask_only")
    assert (dvr.renderer, dvr.refine) == ("first_crossing", None)
    assert (mask_only.renderer, mask_only.refine) == ("silhouette", None)


def test_fusion_is_not_a_configuration_of_the_fit() -> None:
    with pytest.raises(ValueError, match="tsdf is not a configuration of the fit"):
        method_config("tsdf")


def test_reconstructions_by_a_method(monkeypatch, decoder) -> None:
    """Fusion gives the open surface; the others are fits on one core."""
    calls = []
    monkeypatch.setattr(ablations, "reconstruct_tsdf", lambda *args: calls.append(args[-1]) or [])
    monkeypatch.setattr(ablations, "reconstruct", lambda *args: calls.append(args[-2:]) or [])
    reconstruct_by("tsdf", [], [], decoder, SupportPlane(), BASE)
    reconstruct_by("dvr", [], [], decoder, SupportPlane(), BASE)
    fusion, (config, options) = calls
    assert not fusion.closed
    assert config == method_config("dvr", BASE) and options.workers == 1
