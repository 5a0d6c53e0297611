"""Scans from arrays: what they refuse."""

import numpy as np
import pytest

from calgraph import InputError, LaserScan


@pytest.mark.parametrize("nothing", [0.0, -1.0])
def test_a_range_of_zero_or_less_is_refused_with_its_beam(nothing: float) -> None:
    with pytest.raises(InputError, match=r"beam 2 has a range of -?\d m; .* must be NaN"):
        LaserScan(5.0, "laser", np.zeros(3), np.array([1.0, 2.0, nothing]))


def test_beams_without_a_measurement_are_not_valid() -> None:
    scan = LaserScan(5.0, "laser", np.zeros(4), np.array([1.0, np.nan, np.inf, -np.inf]))
    assert scan.valid.tolist() == [True, False, False, False]
