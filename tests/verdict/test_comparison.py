"""Words for displacements, and the limits of the test that compares poses."""

import numpy as np
import pytest
from scipy.stats import chi2, norm

from calgraph.verdict.comparison import AxisComparison, SignificanceTest, _grade_axes, format_displacement


@pytest.mark.parametrize(
    ("value", "axis", "sign", "expected"),
    [
        (0.01234, 0, False, "12.3 mm"), (0.01234, 2, True, "+12.3 mm"), (-0.002, 1, True, "-2.0 mm"),
        (0.01, 3, False, "0.57°"), (-0.01, 5, False, "-0.57°"), (0.01, 4, True, "+0.57°"),
        (-2e-5, 0, True, "+0.0 mm"), (-2e-5, 3, False, "0.00°"),
    ],
)  # fmt: skip
def test_displacements_are_in_tenths_of_a_millimetre_and_hundredths_of_a_degree(
    value: float, axis: int, sign: bool, expected: str
) -> None:
    assert format_displacement(value, axis, sign=sign) == expected


@pytest.mark.parametrize("probability", [0.001, 0.05])
def test_limits_have_the_false_alarm_probability(probability: float) -> None:
    """Of six parameters jointly, and of one on either side."""
    limits = SignificanceTest.of(probability)
    assert chi2.sf(limits.max_chi2, 6) == pytest.approx(probability)
    assert 2 * norm.sf(limits.max_sigmas) == pytest.approx(probability)


ALLOWED = np.repeat([0.01, 0.005], 3)
MAX_STDDEV = ALLOWED / 2


def test_an_axis_that_is_significant_alone_fails_only_if_all_six_together_are() -> None:
    # 3.5 standard deviations: beyond the limit of one axis (3.3), within that of six (4.7).
    offset, stddev = np.zeros(6), np.full(6, 1e-3)
    offset[0], stddev[0] = 0.012, 0.012 / 3.5
    test = SignificanceTest.of(1e-3)
    assert "fail" not in _grade_axes(offset, np.diag(stddev**2), ALLOWED, MAX_STDDEV, test)
    stddev[0] = 0.012 / 4.9
    assert _grade_axes(offset, np.diag(stddev**2), ALLOWED, MAX_STDDEV, test) == ["fail", *["pass"] * 5]


@pytest.mark.parametrize(("squared", "outcome"), [(20.0, "warn"), (30.0, "fail")])
def test_uncertain_axes_fail_if_no_pose_within_the_tolerance_is_likely(squared: float, outcome: str) -> None:
    """x and y are uncertain by 1 m each, but their difference, off by 0.2 m, is not; the limit is 22.5."""
    offset = np.array([0.1, -0.1, 0, 0, 0, 0])
    covariance = np.diag([1.0, 1.0, 1e-6, 1e-6, 1e-6, 1e-6])
    # The nearest pose within the tolerance leaves 0.18 m of the difference.
    covariance[0, 1] = covariance[1, 0] = 1 - 0.18**2 / squared / 2
    assert _grade_axes(offset, covariance, ALLOWED, MAX_STDDEV, SignificanceTest.of(1e-3))[:2] == [
        outcome,
        outcome,
    ]


@pytest.mark.parametrize(("offset", "outcome"), [(0.01, "warn"), (0.0101, "fail")])
def test_a_displacement_as_large_as_the_tolerance_does_not_fail(offset: float, outcome: str) -> None:
    found = _grade_axes(offset * np.eye(6)[0], 1e-6 * np.eye(6), ALLOWED, MAX_STDDEV, SignificanceTest.of(1e-3))
    assert found == [outcome, *["pass"] * 5]


@pytest.mark.parametrize(("stddev", "outcome"), [(0.0049, "pass"), (0.0051, "warn")])
def test_an_axis_is_uncertain_beyond_the_limit_of_a_standard_deviation(stddev: float, outcome: str) -> None:
    covariance = np.diag([stddev**2, *[1e-8] * 5])
    found = _grade_axes(np.zeros(6), covariance, ALLOWED, MAX_STDDEV, SignificanceTest.of(1e-3))
    assert found == [outcome, *["pass"] * 5]


@pytest.mark.parametrize(
    ("stddev", "estimate", "needed"),
    [(0.01, 0.01, 4.0), (0.005, 0.004, 1.0), (0.01, 0.008, np.inf), (0.006, 0.0048, 23.04 / 12.04)],
)
def test_captures_needed_leave_the_uncertainty_of_the_given_pose(
    stddev: float, estimate: float, needed: float
) -> None:
    """The last one: variances 36 of both, of which 12.96 stay; 25 are allowed, so that 23.04 become 12.04."""
    axis = AxisComparison("x", 0.0, stddev, "warn", 0.005, estimate)
    assert axis.captures_needed == pytest.approx(needed)
