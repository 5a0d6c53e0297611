"""Formatting of numbers."""

import math

import pytest

from calgraph.report.formatting import format_angle, format_fixed, format_length, format_significant


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0.00123, "1.2 mm"), (0.0801, "80 mm"), (0.9, "900 mm"), (1.26, "1.3 m"), (1e3, "1000 m"), (1e6, "> 10 km"),
     (0.0, "0 mm"), (math.inf, "∞"), (math.nan, "?"), (1.23e-5, "0.012 mm")],
)  # fmt: skip
def test_lengths(value: float, shown: str) -> None:
    assert format_length(value) == shown


@pytest.mark.parametrize(
    ("value", "shown"), [(0.001, "0.057°"), (0.1, "5.7°"), (4.0, "> 180°"), (math.inf, "> 180°"), (math.nan, "?")]
)
def test_angles(value: float, shown: str) -> None:
    assert format_angle(value) == shown


@pytest.mark.parametrize(("value", "shown"), [(-0.12, "−0.12"), (1234.0, "1234"), (0.0996, "0.10"), (9.99, "10")])
def test_two_digits(value: float, shown: str) -> None:
    assert format_significant(value) == shown


@pytest.mark.parametrize(("value", "shown"), [(-1e-9, "0.000"), (-1.5, "−1.500"), (math.inf, "∞")])
def test_fixed_decimals(value: float, shown: str) -> None:
    assert format_fixed(value, 3) == shown
