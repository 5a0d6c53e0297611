"""Captures that were rejected count by sensor, if another sensor shares them."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.diagnostics.rig.capture_losses import find_lost_captures
from calgraph.estimation.rig.solution import SolvedBundle
from detected_rigs import DetectedRig, detect_rig


@pytest.fixture(scope="module")
def detected() -> DetectedRig:
    return detect_rig()


@pytest.fixture(scope="module")
def solved(detected: DetectedRig) -> SolvedBundle:
    found = detected.solve().solved_bundle
    assert found is not None
    return found


def without(solved: SolvedBundle, share: float, *names: str) -> SolvedBundle:
    """The solution without a share of the views of some sensors."""
    bundle = solved.bundle
    views = [
        v.select(np.arange(len(v.board)) >= round(share * len(v.board))) if name in names else v
        for name, v in zip(bundle.sensors, bundle.views, strict=True)
    ]
    return replace(solved, bundle=bundle.with_views([*views, *bundle.outlines]))


def test_captures_that_are_used_are_not_lost(detected: DetectedRig, solved: SolvedBundle) -> None:
    assert list(find_lost_captures(detected.captures, solved)) == []
    assert list(find_lost_captures(detected.captures, without(solved, 0.15, "camera"))) == []


@pytest.mark.parametrize(("share", "weak"), [(0.3, ()), (0.5, ("camera",))])
def test_lost_captures_are_counted(
    detected: DetectedRig, solved: SolvedBundle, share: float, weak: tuple[str, ...]
) -> None:
    (found,) = find_lost_captures(detected.captures, without(solved, share, "camera"))
    shared = len(detected.captures.detections["camera"])
    lost = round(share * shared)
    assert f"rejected, {lost} of {shared} of camera: check" in found.text
    assert found.sensors == weak


def test_captures_that_tie_no_other_sensor_are_lost(detected: DetectedRig, solved: SolvedBundle) -> None:
    (found,) = find_lost_captures(detected.captures, without(solved, 0.5, "camera", "laser_front"))
    assert set(found.sensors) == {"camera", "laser_front", "lidar"}
