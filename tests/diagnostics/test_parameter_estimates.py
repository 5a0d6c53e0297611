"""Estimates of parameters that the data do not distinguish."""

import numpy as np
import pytest

from calgraph.diagnostics.parameter_estimates import ParameterEstimates
from calgraph.result import EstimatedParameter


def test_parameters_with_the_same_effect_are_alternatives() -> None:
    # Their difference is observed with a standard deviation of 0.1; priors of 1 and 2 split it.
    parameters = [EstimatedParameter(of, "range bias", "m", 0.0, 1.0, 0.0, 1.0) for of in "ab"]
    prior, direction = np.diag([1.0, 0.25]), np.array([1.0, -1.0])
    covariance = np.linalg.inv(prior + 100 * np.outer(direction, direction))
    estimates = ParameterEstimates(
        parameters, covariance @ (100 * direction * 5.0), np.array([1.0, 2.0]), covariance, 0.05
    )
    np.testing.assert_allclose(estimates.deviation, [1, -4], atol=0.02)
    # Together they explain 5; so does the first alone.
    assert estimates.deviation_alone(0, np.array([1])) == pytest.approx(5, rel=0.02)
    assert estimates.deviation_alone(1, np.array([0])) == pytest.approx(-5, rel=0.02)
    assert estimates.indistinguishable(0, 0.9).tolist() == [1]
    # As estimates of a difference that priors predict to the root of 5, both are off by as much.
    np.testing.assert_allclose(np.abs(estimates.normalized), np.sqrt(5), rtol=0.02)
    text, causes = estimates.describe(0, np.array([1]))
    assert causes == [0, 1]
    assert text.startswith(
        "ranges of a are 4.95e+03 mm longer than they should be, or ranges of b are 4.99e+03 mm shorter than they "
        "should be (these 2 cannot be distinguished here); this is 2.2 times its uncertainty in rig"
    )


def test_at_most_three_causes_are_named_the_likeliest_first() -> None:
    parameters = [EstimatedParameter(of, "range bias", "m", 0.0, 1.0, 0.0, 1.0) for of in "abcd"]
    prior_stddev = np.array([1.0, 4.0, 2.0, 3.0])
    covariance = np.asarray(np.linalg.inv(np.diag(prior_stddev**-2) + 1e4))
    estimates = ParameterEstimates(parameters, covariance @ np.full(4, 5e4), prior_stddev, covariance, 0.05)
    assert estimates.describe(0, np.array([1, 2, 3]))[1] == [0, 1, 3]
