"""The calibration of a network from its solution: clocks, tree, and evidence of pairs."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.geometry import se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.checks.assemble import _describe_bodies, assemble_network, build_edge, explain_unconnected
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.joint.ellipses import EllipseObservations
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.joint.solver import linearize_network
from calgraph.network.pairs.hypothesis_evidence import PoseHypothesis
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate, ScannerPairs
from calgraph.network.tracking.track import ScannerTracks, Track
from calgraph.result import Calibration, StatedPose, Verdict
from calgraph.result.finding import Finding
from dense_covariances import relate_all
from leg_scenes import build_network
from solved_networks import solve_two_walks

NAMES = ("west", "east", "north")
T_ROOT = se2.pose(np.array([0.0, 2.5, -1.5]), np.array([[0.0, 0.0], [8.0, 1.0], [4.0, 6.0]]))
OFFSET = np.array([0.0, 0.7, -0.4])
INFORMATION = np.array([1e4, 1e6, 1e5])
"""Of the pairs west-east, west-north and east-north, 1/m²."""
PAIRS = np.array([[0, 1], [0, 2], [1, 2]])
EMPTY = np.zeros((0, 2))


def build_tracks(scanner: int) -> ScannerTracks:
    """The track of one walk by the clock of a scanner."""
    times = 1000 + np.arange(0, 4, 0.05)
    positions = np.column_stack([times - 1000, np.full(len(times), 2.0)])
    covariances = np.tile(1e-4 * np.eye(2), (len(times), 1, 1))
    velocities = np.tile([1.0, 0.0], (len(times), 1))
    T = se2.inverse(T_ROOT[scanner])
    track = Track(times + OFFSET[scanner], se2.apply(T, positions), velocities, covariances, period=0)
    return ScannerTracks((track,), EMPTY, 0.01)


def build_pair(k: int, error: float = 0.0) -> ScannerPairEstimate:
    """A pair with 30 matches of 60 expected ones, whose pose is off by ``error`` along x, m."""
    i, j = PAIRS[k]
    T = se2.inverse(T_ROOT[i]) @ T_ROOT[j]
    T[0, 2] += error
    hypothesis = PoseHypothesis(
        T, INFORMATION[k] * np.eye(3), 30, 1.0, 0.5, 0.2, 0.0, False, float(OFFSET[j] - OFFSET[i]), 0.012
    )
    return ScannerPairEstimate(NAMES[i], NAMES[j], (hypothesis,))


def assemble(
    joint: bool = True,
    inliers: tuple[bool, ...] = (True, True, True),
    findings: tuple[Finding, ...] = (),
    stated: Mapping[str, Mapping[str, object]] | None = None,
    averaged_variance: float = 1.0,
) -> Calibration:
    rig = Rig.model_validate(
        {
            "root": "west",
            "target": {"kind": "people"},
            "sensors": {
                name: {"kind": "lidar2d", "topic": f"/{name}", **(stated or {}).get(name, {})}
                for name in (*NAMES, "cellar")
            },
        }
    )
    estimates = [build_pair(k, 0.03 if k == 0 else 0.0) for k in range(3)]
    pairs: ScannerPairs = {(pair.sensor_a, pair.sensor_b): pair for pair in estimates}
    pairs = {**pairs, ("west", "cellar"): Rejected("too few"), ("east", "cellar"): Rejected("too few")}
    T = np.array([pair.T_a_b for pair in estimates])
    graph = PoseGraph(3, PAIRS, T, INFORMATION[:, None, None] * np.eye(3))
    covariance = np.zeros((12, 12))
    covariance[np.arange(4, 12), np.arange(4, 12)] = 1e-6
    return assemble_network(
        rig,
        dict.fromkeys((*NAMES, "cellar"), ""),
        {**{name: build_tracks(k) for k, name in enumerate(NAMES)}, "cellar": build_tracks(0)},
        NetworkInitialization(pairs, graph, NAMES, PoseGraphSolution(T_ROOT, np.array(inliers))),
        1000.0,
        NetworkSolution(T_ROOT, OFFSET, relate_all(covariance, 3)) if joint else None,
        findings,
        averaged_variance=averaged_variance,
    )


def test_findings_in_the_recording_are_remarks_and_make_their_scanners_weak() -> None:
    found = assemble(findings=(Finding("a slip"), Finding("the same data", (NAMES[1], "cellar"))))
    assert found.evidence.remarks == ("a slip", "the same data")
    verdicts = {sensor.name: sensor.verdict for sensor in found.sensors}
    assert verdicts == {
        NAMES[0]: Verdict("good"),
        NAMES[1]: Verdict("weak", "the same data"),
        NAMES[2]: Verdict("good"),
    }


def test_tracks_are_matched_by_the_clock_of_the_root() -> None:
    rows = [row for row in assemble().evidence.captures if row.sensor != "cellar"]
    assert [(row.sensor, row.used) for row in rows] == [(name, True) for name in sorted(NAMES)]
    assert [row.residual for row in rows] == pytest.approx([0.0] * 3, abs=1e-6)


def test_rows_are_by_the_clock_of_the_root() -> None:
    starts = [row.start for row in assemble().evidence.captures if row.sensor != "cellar"]
    np.testing.assert_allclose(starts, 0.0, atol=0.1)


def test_clock_offsets_are_stated_but_for_the_root() -> None:
    clocks = [(one.clock_offset, one.clock_offset_stddev) for one in assemble().sensors]
    assert clocks == [(None, None), (0.7, pytest.approx(0.001)), (-0.4, pytest.approx(0.001))]


def test_without_a_joint_solution_clocks_are_those_of_the_pairs() -> None:
    """The standard deviation of a pair is 12 ms, and 5 ms that its covariance does not contain."""
    found = assemble(joint=False)
    assert (found.sensors[0].clock_offset, found.sensors[0].clock_offset_stddev) == (None, None)
    assert [one.clock_offset for one in found.sensors[1:]] == pytest.approx(OFFSET[1:].tolist())
    stddev = 0.013 * np.sqrt(2 / 3)
    assert [one.clock_offset_stddev for one in found.sensors[1:]] == pytest.approx([stddev, stddev])
    used = [(row.sensor, row.used) for row in found.evidence.captures if row.sensor != "cellar"]
    assert used == [(name, True) for name in sorted(NAMES)]


def test_averaged_poses_have_the_variances_of_their_pairs_times_a_factor() -> None:
    of_pairs, wider = (assemble(joint=False, averaged_variance=one) for one in (1.0, 3.0))
    assert np.diag(of_pairs.joint_covariance)[6:8].all()
    np.testing.assert_allclose(wider.joint_covariance, 3 * of_pairs.joint_covariance)
    for before, after in zip(of_pairs.sensors[1:], wider.sensors[1:], strict=True):
        assert before.clock_offset_stddev is not None
        assert after.clock_offset_stddev == pytest.approx(np.sqrt(3) * before.clock_offset_stddev)


def test_parents_follow_the_edges_with_the_most_information() -> None:
    assert [one.parent for one in assemble().sensors] == [None, "north", "west"]


def test_an_edge_states_expected_and_matched_positions_and_its_distance_from_the_solution() -> None:
    first = assemble().evidence.edges[0]
    assert (first.captures, first.inliers, first.in_tree) == (60, 30, False)
    np.testing.assert_allclose(first.residuals, [0.03])


def test_an_outlier_pair_has_no_inliers() -> None:
    first = assemble(inliers=(False, True, True)).evidence.edges[0]
    assert (first.captures, first.inliers, first.in_tree) == (60, 0, False)
    assert first.note == "contradicts the other pairs"


def test_an_unconnected_scanner_has_the_reasons_of_its_pairs() -> None:
    assert assemble().evidence.unconnected == {"cellar": "has 1 track, but west, east: too few"}


def test_scanners_without_a_pose_have_the_reason_of_a_root_without_tracks() -> None:
    followed: dict[str, ScannerTracks | Rejected] = {"west": Rejected("it moves"), "east": build_tracks(1)}
    assert explain_unconnected("east", "west", followed, {}) == "the root west is not calibrated: it moves"


def test_initial_poses_are_those_of_averaging_where_a_joint_solution_follows() -> None:
    initial = assemble().evidence.initial_poses
    np.testing.assert_allclose([initial[name] for name in NAMES], se2.to_se3(T_ROOT))
    assert assemble(joint=False).evidence.initial_poses == {}


def test_without_a_joint_solution_the_covariance_is_that_of_averaging() -> None:
    found = assemble(joint=False)
    covariance = found.joint_covariance
    assert covariance is not None
    # North is measured directly with 1 mm, and through east with 10 mm.
    assert np.sqrt(covariance[12, 12]) == pytest.approx(0.001, rel=0.05)
    assert found.evidence.estimator == "averaging"


def test_an_outlier_pair_states_the_expected_positions_of_its_first_hypothesis() -> None:
    pair = build_pair(0)
    second = replace(pair.hypotheses[0], observations=20)
    several = replace(pair, hypotheses=(*pair.hypotheses, second))
    assert build_edge(("west", "east"), several, {}, {}).captures == 60


def test_the_distance_of_an_edge_is_that_of_its_nearest_hypothesis() -> None:
    far, near = build_pair(0, 0.5), build_pair(0, -0.02)
    several = replace(far, hypotheses=(*far.hypotheses, replace(near.hypotheses[0], observations=20)))
    found = build_edge(("west", "east"), several, {("west", "east"): (T_ROOT[0], T_ROOT[1])}, {"east": "west"})
    assert (found.captures, found.inliers, found.in_tree) == (40, 20, True)
    np.testing.assert_allclose(found.residuals, [0.02])


def test_a_rejected_pair_has_an_edge_without_positions_that_states_the_reason() -> None:
    last = assemble().evidence.edges[-1]
    assert (last.captures, last.inliers, last.in_tree, last.note) == (0, 0, False, "too few")


def test_scanners_without_frame_are_in_the_frame_of_their_name() -> None:
    assert tuple(one.frame_id for one in assemble().sensors) == NAMES


def test_heights_and_tilts_are_those_of_rig_yaml() -> None:
    assert [one.stated for one in assemble().sensors] == [None, None, None]
    found = assemble(stated={"west": {"mounting": "inverted"}, "east": {"height": 2.1, "roll": 1.0}})
    assert found["east"].stated == StatedPose(2.1, float(np.radians(1.0)), 0.0, inverted=True)
    assert found["north"].stated == StatedPose(inverted=True)


def test_bodies_of_the_joint_solution_are_named() -> None:
    problem, state = build_network()
    solved = linearize_network(problem, state)
    people = solve_two_walks(np.random.default_rng(0))
    ellipses = [one for one in people.network.bodies if isinstance(one, EllipseObservations)]
    cylinders = tuple(replace(one, faces_forward=False) for one in ellipses)
    for one, expected in (
        (solved, f"legs ({len(problem.bodies)} tracked)"),
        (people, "ellipses (2 tracked)"),
        (replace(people, network=replace(people.network, bodies=cylinders)), "cylinders (2 tracked)"),
    ):
        joint = NetworkSolution(T_ROOT, OFFSET, relate_all(np.eye(12), 3), one)
        assert str(_describe_bodies(joint)) == expected
    assert assemble().evidence.bodies is None


def test_rare_reasons_come_first_and_those_that_differ_in_numbers_are_one() -> None:
    """A scanner of a large network was compared with many others elsewhere, and matches one by chance."""
    pairs: ScannerPairs = {(f"s{k}", "cellar"): Rejected(f"only {0.5 * k} s") for k in range(20)}
    pairs = {**pairs, ("west", "cellar"): Rejected("by chance")}
    tracked = dict.fromkeys(("cellar", "west"), build_tracks(0))
    assert explain_unconnected("cellar", "west", tracked, pairs) == (
        "has 1 track, but west: by chance; s0, s1, s2, s3, s4, s5, s6, s7 and 12 others: only 0.0 s"
    )


def test_a_sensor_without_tracks_has_no_number_of_them() -> None:
    empty = replace(build_tracks(0), tracks=())
    pairs: ScannerPairs = {("west", "hall"): Rejected("too few")}
    assert explain_unconnected("hall", "west", {"west": build_tracks(1), "hall": empty}, pairs) == (
        "no person was tracked; west: too few"
    )
