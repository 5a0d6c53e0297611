"""Equations that are singular end in one line that states what to do."""

import numpy as np
import pytest

from calgraph.errors import CalibrationError
from calgraph.rig.bundle.problem import explain_singular_equations


@explain_singular_equations()
def solve_without_information() -> None:
    np.linalg.solve(np.zeros((6, 6)), np.zeros(6))


def test_singular_equations_are_explained() -> None:
    with pytest.raises(
        CalibrationError, match=r"do not determine its pose; record more captures .*Singular matrix"
    ):
        solve_without_information()
