"""Corrections of simulated sensors against their errors, and remarks on certain errors that matter."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.config import Tolerance
from calgraph.result import Correction
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.checks.uncorrected_errors import collect_corrections, find_uncorrected_errors
from calgraph.simulation import LaserOptions
from detected_rigs import QUICK, DetectedRig, detect_rig
from rig_errors import CameraErrors, ModelErrors, ScannerErrors

BIAS = -0.044
# Of which four are off, as those of a real VLP-16 are.
RING_BIAS = tuple(np.where(np.arange(16) % 4 == 1, [0.019, -0.014] * 8, 0.0).tolist())


# A 2-D scanner with fine increments, and boards to its sides: angles are certain to 0.03 %.
WIDE = QUICK.model_copy(
    update={"laser": LaserOptions(count=1, resolution=0.25), "bearings": (-70, -50, -30, -10, 10, 30, 50, 70)}
)


def solve(errors: ModelErrors | None = None, seed: int = 0) -> tuple[DetectedRig, RigSolution]:
    detected = detect_rig(WIDE, seed=seed, errors=errors)
    return detected, detected.solve()


def remarks(detected: DetectedRig, solution: RigSolution, contradicted: tuple[str, ...] = ()) -> list[str]:
    corrections = collect_corrections(detected.rig, solution)
    return [one.text for one in find_uncorrected_errors(detected.rig, solution, corrections, contradicted)]


@pytest.fixture(scope="module")
def right() -> tuple[DetectedRig, RigSolution]:
    return solve()


@pytest.fixture(scope="module")
def wrong() -> tuple[DetectedRig, RigSolution]:
    """A LiDAR that measures 44 mm short, with four rings off; increments of a laser; and a focal length."""
    return solve(
        ModelErrors(
            cameras={"camera": CameraErrors(focal_length=(0.02, 0.02))},
            scanners={
                "lidar": ScannerErrors(range_bias=BIAS, ring_bias=RING_BIAS),
                "laser_front": ScannerErrors(angle_scale=0.005),
            },
        )
    )


@pytest.fixture(scope="module")
def short(wrong: tuple[DetectedRig, RigSolution]) -> Correction:
    detected, solution = wrong
    return collect_corrections(detected.rig, solution)["lidar"].learned()


def test_corrected_ranges_are_right_within_the_stated_standard_deviation(short: Correction) -> None:
    """Of a LiDAR that measures 44 mm short, with four rings off by up to 19 mm."""
    elevation = short.rings.mean(axis=1)
    # The rings of the simulated LiDAR, of which outer ones may miss all boards.
    ring = np.round((np.degrees(elevation) + 15) / 2).astype(int)
    directions = np.column_stack([np.cos(elevation), np.zeros(len(ring)), np.sin(elevation)])
    measured = short.distance + BIAS + np.array(RING_BIAS)[ring]
    off = np.linalg.norm(short.correct(directions * measured[:, None]), axis=1) - short.distance
    _, (stddev,) = short.measure(short.range_effects()[None])
    _, of_rings = short.measure(short.ring_effects())
    assert abs(off.mean()) < 2 * stddev < 0.02
    assert (np.abs(off - off.mean()) < 4 * of_rings).all()
    assert np.abs(off - off.mean()).max() < 0.003


def test_the_covariance_is_that_of_the_parameters(short: Correction) -> None:
    stddev = [one.stddev for one in short.parameters]
    np.testing.assert_allclose(np.sqrt(np.diag(short.covariance)), stddev, rtol=1e-9)


def test_biases_of_rings_and_the_range_bias_are_correlated(short: Correction) -> None:
    """The sum of range bias and mean ring bias is certain, its parts are less so."""
    rings = np.arange(len(short.parameters)) >= len(short.parameters) - len(short.rings)
    mean = rings / rings.sum()
    bias = np.eye(len(rings))[0]
    (together, apart, _) = short.measure(np.array([bias + mean, bias, mean]))[1]
    assert together < 0.9 * np.hypot(apart, short.measure(mean[None])[1][0])


def test_the_working_distance_is_the_median_of_the_boards(right: tuple[DetectedRig, RigSolution]) -> None:
    """Of boards 1.5, 2.2 and 3 m from the robot."""
    found = collect_corrections(right[0].rig, right[1])
    assert sorted(found) == ["camera", "laser_front", "lidar"]
    for correction in found.values():
        assert correction.distance == pytest.approx(2.2, abs=0.3)


def test_a_right_rig_has_no_remarks(right: tuple[DetectedRig, RigSolution]) -> None:
    assert remarks(*right) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 5))
def test_right_rigs_have_no_remarks(seed: int) -> None:
    assert remarks(*solve(seed=seed)) == []


@pytest.mark.parametrize(
    "text",
    [
        "lidar measures 4",
        "certain errors of rings above 5 mm",
        "angles between beams of laser_front are 0.",
        "by its stated intrinsics, corners in images of camera are displaced by",
    ],
)
def test_a_certain_error_that_matters_is_remarked(text: str, wrong: tuple[DetectedRig, RigSolution]) -> None:
    (found,) = [one for one in remarks(*wrong) if text in one]
    assert "export c" in found


def test_a_certain_error_that_does_not_matter_is_not_remarked(wrong: tuple[DetectedRig, RigSolution]) -> None:
    """With a tolerance of 0.2 m."""
    detected, solution = wrong
    loose = detected.rig.model_copy(update={"tolerance": Tolerance(translation=0.2, rotation=5.0)})
    assert remarks(replace(detected, rig=loose), solution) == []


def test_a_sensor_that_is_contradicted_has_no_remark(wrong: tuple[DetectedRig, RigSolution]) -> None:
    assert [text for text in remarks(*wrong, ("lidar", "camera")) if "laser_front" not in text] == []
