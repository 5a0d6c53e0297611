"""Verdicts, drifts and reasons of networks in space whose root is a LiDAR, the floor, or a 2-D scanner."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.scanner_pairs import CorrectedPairs
from calgraph.network.space.assemble import (
    _explain_unconnected,
    _find_contradictions,
    _grade_poses,
    _list_drifts,
    _relate_to,
)
from calgraph.network.space.joint import SpaceSolution, solve_space
from calgraph.network.space.observations import SpaceObservations, StaticStep
from calgraph.network.space.pipeline import _describe_steps, _state_stddev
from calgraph.network.space.start import SpaceStart
from calgraph.network.tracking.track import ScannerTracks
from calgraph.result import Verdict
from calgraph.result.finding import Finding
from calgraph.surfaces.sensor_states import DRIFT, number_free
from network.space.space_scenes import build_scene, perturb, prior_of

LIDARS, SCANNER = ("lidar_0", "lidar_1"), "scanner_2"
NAMES = (*LIDARS, SCANNER)
HEIGHT, TILT = 0.05, np.radians(0.5)
"""Standard deviations of what is stated of the scanner, m and rad."""


@cache
def solved() -> tuple[dict[str, SpaceObservations], SpaceSolution]:
    """Two LiDARs and a scanner in a hall, with accurate ranges, over floors known to 1 mm and 0.5 mrad."""
    scene = build_scene(0, duration=20.0, scanner=0.7)
    prior = prior_of(3, bias=0.002, scale=2e-4)
    prior[2, 2:5] = HEIGHT, TILT, TILT
    solution = solve_space(scene.observations, perturb(scene.truth, np.random.default_rng(0)), prior)
    covariance = np.diag([5e-4, 5e-4, 1e-3]) ** 2
    observed = [
        replace(one, T_floor_sensor=state.T_root_sensor, floor_covariance=covariance)
        for one, state in zip(scene.observations, scene.truth, strict=True)
    ]
    return dict(zip(NAMES, observed, strict=True)), solution


def rig_of(root: str, *scanners: str, tolerance: float = 0.05, drift: float = 3e-5) -> Rig:
    of_scanner = {"kind": "lidar2d", "uncertainty": {"clock_drift": drift}}
    kinds = {name: of_scanner if name in (SCANNER, *scanners) else {"kind": "lidar3d"} for name in NAMES}
    return Rig.model_validate(
        {
            "root": root,
            "target": {"kind": "people"},
            "tolerance": {"translation": tolerance, "rotation": 3.0},
            "sensors": {name: {"topic": f"/{name}", **one} for name, one in kinds.items()},
        }
    )


def grade(rig: Rig, *findings: Finding) -> dict[str, Verdict]:
    observed, solution = solved()
    return _grade_poses(rig, NAMES, solution, observed, findings)


@pytest.mark.parametrize("root", [*NAMES[::2], "floor"])
def test_a_lidar_that_others_are_relative_to_makes_all_weak_if_it_moved(root: str) -> None:
    """2-D scanners, which are not solved without it, as well; another LiDAR makes itself weak only."""
    observed, _ = solved()
    step = StaticStep(10.0, 0.005, 0.001)
    for moved, weak in ((LIDARS[0], {*NAMES} - {root}), (LIDARS[1], {LIDARS[1]})):
        measured = {name: replace(observed[name], step=step if name == moved else None) for name in LIDARS}
        (finding,) = _describe_steps(LIDARS[0], NAMES, measured, 0.0)
        assert finding.sensors == (NAMES if moved == LIDARS[0] else (moved,))
        verdicts = grade(rig_of(root), finding)
        named = {name for name, one in verdicts.items() if "moved 10 s from the start" in one.reason}
        assert named == weak
        assert all(verdicts[name].grade != "good" for name in weak)
        assert verdicts[root].grade == "good"


@pytest.mark.parametrize("root", NAMES)
def test_what_makes_the_root_weak_makes_all_weak(root: str) -> None:
    verdicts = grade(rig_of(root), Finding("it was bumped", (root,)))
    assert {name for name, one in verdicts.items() if "it was bumped" in one.reason} == {*NAMES} - {root}


def test_the_largest_source_of_errors_is_that_of_the_root() -> None:
    """The height of a LiDAR over the floor is known to 1 mm, relative to a scanner to 5 cm."""
    by_lidar, by_floor, by_scanner = (grade(rig_of(root, tolerance=1e-4)) for root in (NAMES[0], "floor", SCANNER))
    assert "the floor" not in by_lidar[LIDARS[1]].reason
    assert by_floor[LIDARS[0]].grade == "weak"
    assert "the largest source of height (z): the floor (100 %)" in by_floor[LIDARS[0]].reason
    assert f"let more of the floor be in the view of {LIDARS[0]}" in by_floor[LIDARS[0]].reason
    for name in LIDARS:
        assert "stated height and tilt of the root (100 %)" in by_scanner[name].reason
        assert (
            f"that the root {SCANNER} measures do not show its height, roll and pitch" in by_scanner[name].reason
        )
    for verdicts in (by_lidar, by_floor):
        assert "stated height and tilt (" in verdicts[SCANNER].reason
        assert "that a 2-D scanner measures do not show its height" in verdicts[SCANNER].reason


@pytest.mark.parametrize(
    ("stddev", "source", "of"),
    [(0.0, "tilt of the root (100 %)", f"the root {SCANNER}"), (0.2, "tilt (", "a 2-D scanner")],
)
def test_the_heights_of_two_scanners_are_two_sources(stddev: float, source: str, of: str) -> None:
    """That of the root is known to 5 cm and half a degree; that of another one to 1 mm, or to 0.2 m."""
    observed, solution = solved()
    height = np.zeros(len(solution.covariance))
    height[number_free(solution.free)[1, 2]] = stddev
    covariance, with_ranges = (
        one + np.outer(height, height) for one in (solution.covariance, solution.with_ranges)
    )
    changed = replace(solution, covariance=covariance, with_ranges=with_ranges)
    rig = rig_of(SCANNER, LIDARS[1], tolerance=1e-4)
    reason = _grade_poses(rig, NAMES, changed, observed, ())[LIDARS[1]].reason
    assert f"stated height and {source}" in reason
    assert f"that {of} measures do not show its height, roll and pitch" in reason


def test_sensors_without_common_people_are_named() -> None:
    """As if LiDARs alone measured people."""
    _, solution = solved()
    alone = replace(solution, persons=[replace(one, sensors=np.array([0, 1])) for one in solution.persons])
    text = "no person or vehicle was measured by {} and another sensor at the same time and place"
    assert text.format("it") in _find_contradictions(alone, 2, 0, False)
    assert text.format("the root") in _find_contradictions(alone, 1, 2, True)
    for of, k, root in ((alone, 1, 0), (alone, 0, 1), (solution, 2, 0), (solution, 1, 2)):
        assert not any("no person" in one for one in _find_contradictions(of, k, root, k < 2))


def test_drifts_are_relative_to_the_root() -> None:
    """That of lidar_1 is of two clocks that drift from that of lidar_0 by up to 30 ppm."""
    _, solution = solved()
    of_lidar, of_scanner = (
        {one.of: one for one in _list_drifts(NAMES, solution, root)} for root in (NAMES.index(LIDARS[0]), 2)
    )
    assert list(of_lidar) == [LIDARS[1], SCANNER]
    assert list(of_scanner) == [*LIDARS]
    assert of_lidar[SCANNER].value != 0.0
    assert of_scanner[LIDARS[0]].value == pytest.approx(-of_lidar[SCANNER].value)
    assert of_scanner[LIDARS[1]].value == pytest.approx(of_lidar[LIDARS[1]].value - of_lidar[SCANNER].value)
    priors = [of_lidar[SCANNER].prior, of_scanner[LIDARS[0]].prior, of_scanner[LIDARS[1]].prior]
    assert priors == pytest.approx([3e-5, 3e-5, np.sqrt(2) * 3e-5])


def test_drifts_are_as_certain_as_before_at_least() -> None:
    wide = solved()[1].scale_covariance(4.0)
    drifts = [one.timing[0] for one in wide.states]
    assert _relate_to(wide, 0, DRIFT, drifts)[1:, 1].min() > 4e-5
    assert [one.stddev for one in _list_drifts(NAMES, wide, 0)] == pytest.approx([3e-5, 3e-5])


def test_states_are_known_as_they_are_stated() -> None:
    """Slopes of the floor to 30 mrad, against which LiDARs are level; scanners as they are stated."""
    observed, _ = solved()
    rig = rig_of(SCANNER, drift=2e-4).model_copy(update={"root": LIDARS[0]})
    root, lidar, scanner = (_state_stddev(rig, name, observed[name]) for name in NAMES)
    assert not root[:7].any()
    assert root[[7, 8, 9]] == pytest.approx([0.02, 0.003, 0.0])
    assert lidar[:7] == pytest.approx([1.0, 1.0, 1.0, 0.03, 0.03, 0.2, 0.1])
    assert lidar[DRIFT] == 3e-5
    assert scanner[2:5] == pytest.approx([1e-3, 5e-4, 5e-4])
    assert scanner[DRIFT] == 2e-4


def test_a_lidar_that_measured_vehicles_only_has_that_reason() -> None:
    observed, _ = solved()
    (track, *_) = observed[LIDARS[0]].tracks
    none = ScannerTracks((), np.zeros((0, 2)), 0.02)
    graph = PoseGraph(1, np.zeros((0, 2), dtype=np.intp), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    averaged = PoseGraphSolution(np.eye(3)[None], np.zeros(0, dtype=np.bool_))
    alone = NetworkInitialization({}, graph, NAMES[:1], averaged)
    reasons = []
    for vehicles in ((track,), ()):
        of_lidars = {name: replace(observed[name], tracks=(), vehicles=vehicles) for name in LIDARS}
        start = SpaceStart(of_lidars, CorrectedPairs({}, {}), alone, {})
        reasons.append(_explain_unconnected(LIDARS[1], LIDARS[0], dict.fromkeys(LIDARS, none), start))
    assert reasons[0] == f"measured vehicles, but {reasons[1]}"
    assert reasons[1].endswith("let people walk from its view into those of its neighbours, with turns")


def test_lidars_that_share_no_floor_have_no_good_height() -> None:
    """As of rings that meet the floor at other places: points of floors of one LiDAR are left out."""
    _, solution = solved()
    shared = solution.shared
    level = np.abs(shared.surfaces.normals[shared.surface, 2]) > 0.9
    kept = ~level | (shared.sensor != 1)
    apart = replace(
        shared,
        points=shared.points[kept],
        sensor=shared.sensor[kept],
        surface=shared.surface[kept],
        height=shared.height[kept],
    )
    without = replace(solution, shared=apart)
    of_floor = "its height rests on walls"
    assert any(of_floor in one for one in _find_contradictions(without, 1, 0, True))
    assert not any(of_floor in one for one in _find_contradictions(solution, 1, 0, True))
    assert not any(of_floor in one for one in _find_contradictions(without, 2, 0, False))
