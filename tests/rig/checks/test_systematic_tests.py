"""Systematic errors beyond their priors are named, with the sensors that they concern; right rigs have none."""

from dataclasses import dataclass

import numpy as np
import pytest

from calgraph.result.finding import Finding
from calgraph.rig.checks.contradictions import find_systematic_errors
from detected_rigs import detect_rig
from rig_errors import BoardErrors, CameraErrors, ModelErrors, ScannerErrors

pytestmark = pytest.mark.slow

ALL = ("lidar", "camera", "laser_front")


def findings(errors: ModelErrors | None = None, seed: int = 0) -> tuple[Finding, ...]:
    detected = detect_rig(seed=seed, errors=errors)
    solved = detected.solve().solved_bundle
    assert solved is not None
    return tuple(find_systematic_errors(solved, detected.rig))


@dataclass(frozen=True)
class Case:
    """An error, what is said of it, and the sensors that it makes weak."""

    errors: ModelErrors
    text: str
    sensors: tuple[str, ...]


RINGS = tuple(0.06 * (np.arange(16) == 8))
CASES = {
    "print scale": Case(ModelErrors(BoardErrors(print_scale=0.03)), "the print on the board is", ("camera",)),
    "print aspect": Case(
        ModelErrors(BoardErrors(print_aspect=-0.015)), "the print on the board is 1.6 % narrower", ("camera",)
    ),
    "bow": Case(ModelErrors(BoardErrors(bow=(0.012, 0, 0))), "the board is bent by 12 mm along x", ALL),
    "focal length": Case(
        ModelErrors(cameras={"camera": CameraErrors(focal_length=(0.05, 0.05))}), "focal length of", ("camera",)
    ),
    "distortion": Case(
        ModelErrors(cameras={"camera": CameraErrors(distortion=(0.3,))}),
        "distortion coefficients of camera displace corners",
        ("camera",),
    ),
    "range bias": Case(
        ModelErrors(scanners={"laser_front": ScannerErrors(range_bias=-0.1)}),
        "ranges of laser_front are 99.7 mm shorter than they should be",
        ("laser_front",),
    ),
    "range bias of the root": Case(
        ModelErrors(scanners={"lidar": ScannerErrors(range_bias=0.1)}), "ranges of lidar are", ALL
    ),
    "ring": Case(ModelErrors(scanners={"lidar": ScannerErrors(ring_bias=RINGS)}), "ranges of ring 9", ALL),
}


@pytest.mark.parametrize("seed", range(4))
def test_right_rigs_have_no_findings(seed: int) -> None:
    assert findings(seed=seed) == ()


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_an_error_beyond_its_prior_is_named(case: Case) -> None:
    (found,) = [one for one in findings(case.errors) if case.text in one.text]
    assert set(found.sensors) == set(case.sensors)
    assert "rig.yaml" in found.text
