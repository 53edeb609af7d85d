"""Parameters of the fit and the limits of their steps."""

import numpy as np

from perception.inference.problem import StepLimits


def test_step_limits_follow_the_order_of_the_parameters():
    limits = StepLimits(code=1.0, rotation=2.0, translation=3.0, log_scale=4.0).vector
    np.testing.assert_array_equal(limits, [1.0] * 16 + [2.0] * 3 + [3.0] * 3 + [4.0] * 3)


def test_default_step_limits():
    assert StepLimits() == StepLimits(code=0.7, rotation=0.2, translation=0.02, log_scale=0.12)
