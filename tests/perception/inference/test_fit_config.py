"""Default settings of a fit."""

from perception.inference.fit_config import FitConfig


def test_default_budget_is_the_papers() -> None:
    assert sum(stage.iterations for stage in FitConfig().stages) == 30
