"""Captures that were rejected count by sensor, if another sensor shares them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.checks.contradictions import find_lost_captures
from calgraph.simulation import MultibeamOptions
from detected_rigs import QUICK, DetectedRig, detect_rig


@pytest.fixture(scope="module")
def detected() -> DetectedRig:
    return detect_rig()


@pytest.fixture(scope="module")
def solved(detected: DetectedRig) -> SolvedBundle:
    found = detected.solve().solved_bundle
    assert found is not None
    return found


def select_views(
    solved: SolvedBundle, kept: Callable[[NDArray[np.intp], int], NDArray[np.bool_]], *names: str
) -> SolvedBundle:
    """The solution with the views of some sensors that are kept, by their position in time and their number."""
    bundle = solved.bundle
    views = [
        v.select(kept(np.argsort(np.argsort(solved.captures[v.board])), len(v.board))) if name in names else v
        for name, v in zip(bundle.sensors, bundle.views, strict=True)
    ]
    return replace(solved, bundle=bundle.with_views([*views, *bundle.outlines]))


def without(solved: SolvedBundle, share: float, *names: str) -> SolvedBundle:
    """The solution without a share of the views of some sensors, the first ones."""
    return select_views(solved, lambda i, n: i >= round(share * n), *names)


def without_last(solved: SolvedBundle, count: int, *names: str) -> SolvedBundle:
    """The solution without some of the last views of some sensors."""
    return select_views(solved, lambda i, n: i < n - count, *names)


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


def test_losses_of_the_root_make_all_poses_weak(detected: DetectedRig, solved: SolvedBundle) -> None:
    root = solved.bundle.sensors[0]
    (found,) = find_lost_captures(detected.captures, without(solved, 0.5, root))
    assert f" of {root}: check" in found.text
    assert found.sensors == solved.bundle.sensors


def test_losses_make_those_poses_weak_that_nothing_else_ties_to_the_root() -> None:
    detected = detect_rig(QUICK.model_copy(update={"multibeam": MultibeamOptions(count=2, resolution=2.0)}))
    solved = detected.solve().solved_bundle
    assert solved is not None
    root, second, camera, laser = solved.bundle.sensors
    early = max(solved.captures) // 3
    # In the first third only the first camera and the laser measure, and later all but the laser.
    captures = detected.captures
    captures = replace(
        captures,
        detections={
            name: {
                capture: found
                for capture, found in by_capture.items()
                if name == camera or (capture <= early) == (name == laser)
            }
            for name, by_capture in captures.detections.items()
        },
    )
    solved = select_views(solved, lambda i, _: i <= early, laser)
    solved = select_views(solved, lambda i, _: i > early, root, second)
    solved = select_views(solved, lambda i, _: (i <= early) | (i % 3 == 0), camera)
    (found,) = find_lost_captures(captures, solved)
    assert set(found.sensors) == {camera, laser}


@pytest.mark.parametrize(("count", "weak"), [(1, ()), (2, ("camera",)), (3, ("camera",))])
def test_last_captures_that_are_lost_make_a_sensor_weak(
    detected: DetectedRig, solved: SolvedBundle, count: int, weak: tuple[str, ...]
) -> None:
    findings = list(find_lost_captures(detected.captures, without_last(solved, count, "camera")))
    assert tuple(name for found in findings for name in found.sensors) == weak
    shared = len(detected.captures.detections["camera"])
    assert all(f"rejected, {count} of {shared} of camera: a sensor may" in found.text for found in findings)


def test_last_captures_among_many_lost_ones_are_lost_by_chance(
    detected: DetectedRig, solved: SolvedBundle
) -> None:
    lost = select_views(solved, lambda i, n: (i % 3 != 1) & (i < n - 2), "camera")
    assert not [f for f in find_lost_captures(detected.captures, lost) if "may have moved" in f.text]
