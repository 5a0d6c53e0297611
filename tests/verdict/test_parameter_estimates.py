"""Estimates of parameters that the data do not distinguish."""

import numpy as np
import pytest

from calgraph.sensors.kinds.stated import RangeUncertainty
from calgraph.verdict.parameter_estimates import DescribedParameter, ParameterEstimates


def range_bias(of: str) -> DescribedParameter:
    error, _ = RangeUncertainty().beam_errors()
    return DescribedParameter(of, error.quantity, error.unit, clause=error.clause)


def test_parameters_with_the_same_effect_are_alternatives() -> None:
    # Their difference is observed with a standard deviation of 0.1; priors of 1 and 2 split it.
    parameters = [range_bias(of) for of in "ab"]
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
    parameters = [range_bias(of) for of in "abcd"]
    prior_stddev = np.array([1.0, 4.0, 2.0, 3.0])
    covariance = np.asarray(np.linalg.inv(np.diag(prior_stddev**-2) + 1e4))
    estimates = ParameterEstimates(parameters, covariance @ np.full(4, 5e4), prior_stddev, covariance, 0.05)
    assert estimates.describe(0, np.array([1, 2, 3]))[1] == [0, 1, 3]


@pytest.mark.parametrize(("names", "of"), [("ab", "a and b"), ("abc", "a, b and c")])
@pytest.mark.parametrize("bias", [0.047, -0.047])
def test_parameters_that_deviate_together_have_the_deviation_that_they_have_in_common(
    names: str, of: str, bias: float
) -> None:
    """Ranges of scanners of a network: data determine differences to 0.1 mm, and what is common to 10 mm."""
    parameters = [range_bias(one) for one in names]
    count = len(names)
    mean = np.full((count, count), 1 / count)
    information = (np.eye(count) - mean) / 1e-4**2 + mean / 0.01**2 * count
    covariance = np.asarray(np.linalg.inv(np.eye(count) / 0.02**2 + information))
    differences = 3e-4 * np.arange(count)
    deviation = bias + differences - differences.mean()
    estimates = ParameterEstimates(parameters, deviation, np.full(count, 0.02), covariance, 0.05)
    others = estimates.indistinguishable(0, 0.9)
    assert len(others) == count - 1
    text, causes = estimates.describe(0, others)
    assert sorted(causes) == list(range(count))
    longer = "longer" if bias > 0 else "shorter"
    ratio = abs(float(estimates.normalized[0]))
    assert ratio == pytest.approx(2.5, abs=0.3)
    assert text.startswith(
        f"ranges of {of} are 47 mm {longer} than they should be (these {count} cannot be distinguished here); "
        f"this is {ratio:.1f} times its uncertainty in rig.yaml (σ 20 mm)"
    )


@pytest.mark.parametrize(
    ("of", "quantity", "sign", "clause", "text"),
    [
        ("board", "width", 1, "the {of} is {size} wider|narrower", "the board is 49 mm wider"),
        ("b", "range bias", -1, range_bias("b").clause, "ranges of b are 49 mm shorter than they should be"),
    ],
)
def test_other_quantities_and_opposite_deviations_are_named_with_their_own_sizes(
    of: str, quantity: str, sign: int, clause: str, text: str
) -> None:
    parameters = [range_bias("a"), DescribedParameter(of, quantity, "m", clause=clause)]
    information = np.array([[1, -sign], [-sign, 1]]) / 1e-4**2 + np.eye(2) / 0.02**2
    covariance = np.asarray(np.linalg.inv(np.eye(2) / 0.02**2 + information))
    deviation = np.array([0.05, 0.049 * sign])
    estimates = ParameterEstimates(parameters, deviation, np.full(2, 0.02), covariance, 0.05)
    described, causes = estimates.describe(0, np.array([1]))
    assert causes == [0, 1]
    assert described.startswith(f"ranges of a are 50 mm longer than they should be, and {text} (these 2 cannot")
