"""Words for displacements, and the limits of the test that compares poses."""

import pytest
from scipy.stats import chi2, norm

from calgraph.diagnostics.comparison import SignificanceTest, format_displacement


@pytest.mark.parametrize(
    ("value", "axis", "sign", "expected"),
    [
        (0.01234, 0, False, "12.3 mm"), (0.01234, 2, True, "+12.3 mm"), (-0.002, 1, True, "-2.0 mm"),
        (0.01, 3, False, "0.57°"), (-0.01, 5, False, "-0.57°"), (0.01, 4, True, "+0.57°"),
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
