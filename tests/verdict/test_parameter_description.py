"""Deviations of systematic parameters as clauses."""

import pytest

from calgraph.network.checks.model_assessment import _CLAUSES
from calgraph.verdict.parameter_estimates import DescribedParameter, describe_deviation


@pytest.mark.parametrize(
    ("deviation", "described"),
    [(0.02, "cx of camera is 0.02 px larger than stated"), (-2.5, "cx of camera is 2.5 px smaller than stated")],
)
def test_a_parameter_without_a_clause_is_called_by_its_quantity(deviation: float, described: str) -> None:
    assert describe_deviation(DescribedParameter("camera", "cx", "px"), deviation) == described


@pytest.mark.parametrize(
    ("quantity", "deviation", "described"),
    [
        ("stretch along diagonal", -0.001,
         "ranges of laser at 45° are 0.1 % shorter than on average, as by a tilt of its scan plane"),
        ("clock drift", 2e-5, "the clock of laser is 20 ppm faster than that of the root"),
        ("angle scale", 0.005, "angles between beams of laser are 0.5 % larger than stated"),
    ],
)  # fmt: skip
def test_a_clause_of_a_network_has_the_word_for_the_sign(quantity: str, deviation: float, described: str) -> None:
    parameter = DescribedParameter("laser", quantity, "", clause=_CLAUSES[quantity])
    assert describe_deviation(parameter, deviation) == described
