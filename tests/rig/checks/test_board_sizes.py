"""A board of another size than stated is named with the size that its edges have; footprints of beams are not."""

import re
from dataclasses import replace

import pytest

from calgraph.config import Board
from calgraph.result.finding import Finding
from calgraph.rig.checks.contradictions import find_systematic_errors
from calgraph.simulation import CameraOptions, LaserOptions, MultibeamOptions
from detected_rigs import QUICK, DetectedRig, detect_rig
from rig_errors import ModelErrors, ScannerErrors

FINE = QUICK.model_copy(
    update={
        "laser": LaserOptions(count=1, resolution=0.5),
        "multibeam": MultibeamOptions(count=1, resolution=0.4),
        "radii": (1.5, 2.2),
    }
)
NO_LASER = FINE.model_copy(update={"laser": LaserOptions(count=0)})
NO_CAMERA = FINE.model_copy(update={"camera": CameraOptions(count=0)})
WIDTH, HEIGHT = 1.2, 0.9


def stated_as(one: DetectedRig, wider: float, higher: float) -> DetectedRig:
    """The same recording with another size in rig.yaml, m."""
    (board,) = one.rig.boards
    assert board.size == (WIDTH, HEIGHT)
    wrong = Board.model_validate({**board.model_dump(), "size": (WIDTH + wider, HEIGHT + higher)})
    return replace(one, rig=one.rig.model_copy(update={"target": wrong}))


def findings(one: DetectedRig) -> tuple[Finding, ...]:
    solved = one.solve().solved_bundle
    assert solved is not None
    return tuple(find_systematic_errors(solved, one.rig))


def measured(finding: Finding) -> list[float]:
    """Width and height in its text, m."""
    return [float(number) for number in re.findall(r"([\d.]+) m (?:wide|high)", finding.text)]


@pytest.mark.parametrize(
    ("wider", "higher", "seed"), [(0.05, 0.05, 0), (0.02, 0.02, 1), (0.1, 0.05, 2), (0.05, 0, 3), (0, -0.05, 4)]
)
def test_the_size_of_the_board_is_named_and_measured(wider: float, higher: float, seed: int) -> None:
    """All in one sentence, rather than as footprints of each scanner."""
    (found,) = findings(stated_as(detect_rig(FINE, seed), wider, higher))
    assert found.text.startswith("by its edges in scans of lidar, laser_front, the board is ")
    assert measured(found) == pytest.approx([WIDTH, HEIGHT], abs=0.006)
    assert f"not {WIDTH + wider:.3f} m and {HEIGHT + higher:.3f} m as rig.yaml states: measure" in found.text


@pytest.mark.parametrize("error", [0.05, -0.08])
def test_without_a_camera_boards_are_registered_by_the_size_that_most_have(error: float) -> None:
    """By the stated one, no board is accepted, and its sides would not be used at all."""
    (found,) = findings(stated_as(detect_rig(NO_CAMERA), error, error))
    assert measured(found) == pytest.approx([WIDTH, HEIGHT], abs=0.006)


@pytest.mark.parametrize(("wider", "weak"), [(0.05, True), (0.02, False)])
def test_sensors_are_weak_where_the_size_is_certainly_wrong(wider: float, weak: bool) -> None:
    """By more than 6 prior standard deviations, 12 mm, whatever the footprint of the only scanner is."""
    (found,) = findings(stated_as(detect_rig(NO_LASER), wider, wider))
    assert measured(found) == pytest.approx([WIDTH, HEIGHT], abs=0.006)
    assert bool(found.sensors) == weak


def test_a_board_stated_too_small_may_be_wide_beams() -> None:
    """Of a scanner alone, neither can be excluded: both are said, and no sensor is weak for it."""
    (found,) = findings(stated_as(detect_rig(NO_LASER), -0.05, -0.05))
    assert measured(found) == pytest.approx([WIDTH, HEIGHT], abs=0.012)
    assert ", or beams are wide: measure" in found.text
    assert not found.sensors


@pytest.mark.parametrize("divergence", [0.0, 0.003, 0.006])
def test_footprints_of_usual_beams_are_no_wrong_size(divergence: float) -> None:
    beams = ScannerErrors(divergence=divergence)
    errors = ModelErrors(scanners={"lidar": beams, "laser_front": beams})
    assert findings(detect_rig(FINE, errors=errors)) == ()
