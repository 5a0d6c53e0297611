"""Deviations of systematic parameters as clauses."""

import numpy as np
import pytest

from calgraph.rig.bundle.bundle_parameters import SystematicParameter
from calgraph.verdict.parameter_estimates import describe_deviation


@pytest.mark.parametrize(
    ("of", "quantity", "unit", "deviation", "clause"),
    [
        ("camera", "focal length", "px", -0.016, "the focal length of camera is 1.6 % shorter than stated"),
        ("camera", "pixel aspect", "", 0.004, "pixels of camera are 0.4 % narrower for their height than stated"),
        ("camera", "cx", "px", 25.0, "cx of camera is 25 px larger than stated"),
        ("laser", "range bias", "m", -0.034, "ranges of laser are 34 mm shorter than they should be"),
        ("laser", "stamp delay", "s", -0.012, "laser measures 12 ms earlier than its stamps state"),
        ("camera", "readout time", "s", 0.02, "camera reads the last row of an image 20 ms later than stated"),
        ("laser", "angle scale", "", 0.005, "angles between beams of laser are 0.5 % larger than stated"),
        ("laser", "stretch along diagonal", "", -0.001,
         "ranges of laser at 45° are 0.1 % shorter than on average, as by a tilt of its scan plane"),
        ("lidar", "bias of ring 3 (+1.0°)", "m", 0.02,
         "ranges of ring 3 (+1.0°) of lidar are 20 mm longer than those of the others"),
        ("lidar", "azimuth footprint", "m", -0.03, "edges of the board in scans of lidar are 30 mm too far in"),
        ("board", "print scale", "", -0.016, "the print on the board is 1.6 % smaller than stated"),
        ("board 2", "bow along y", "m", -0.01, "the board 2 is bent by 10 mm along y"),
        ("board", "print x", "m", 0.008, "the print on the board is 8 mm along x from the stated place"),
        ("board", "print rotation", "rad", float(np.radians(1.5)),
         "the print on the board is rotated by 1.5° from the stated place"),
        ("tag 3", "y", "m", -0.005, "tag 3 is 5 mm along y from the stated place"),
        ("board", "width", "m", 0.012, "the board is 12 mm wider than stated"),
    ],
)  # fmt: skip
def test_a_deviation_is_a_clause(of: str, quantity: str, unit: str, deviation: float, clause: str) -> None:
    assert describe_deviation(SystematicParameter(of, quantity, unit, 1.0, (0,)), deviation) == clause
