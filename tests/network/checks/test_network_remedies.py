"""Remedies of weak scanners, against solutions with the data or the priors that they give."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Lidar2dUncertainty
from calgraph.geometry import Array, se2
from calgraph.network.checks import remedies
from calgraph.network.checks.model_assessment import CORRELATED_BEAMS, DIFFERENCE
from calgraph.network.checks.remedies import _Measure, _Prediction, _record_longer
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.joint.planar_poses import ScannerPrior
from calgraph.network.joint.problem import NetworkProblem, NetworkState, WallConstraint
from calgraph.network.joint.scanner_unknowns import collect_prior_sigma
from calgraph.network.joint.solver import (
    NetworkEquations,
    compute_network_covariance,
    linearize_network,
    list_known_pairs,
)
from calgraph.network.joint.systematic_spread import estimate_systematic_sigma
from calgraph.result import Calibration, load_calibration, save_calibration
from calgraph.sensors.kinds import KINDS
from leg_scenes import T_ROOT, build_network
from taken_remedies import solve_network

NAMES = ("west", "north", "east")
STATED = dict.fromkeys(NAMES, Lidar2dUncertainty())
NOTHING = _Measure("", 0.0)
# Labs with all of the systematic errors' priors, recorded for 20 s, and with a sixteenth of them, for a minute.
LARGE_ERRORS, SMALL_ERRORS, SEED = "lab 1", "lab 0.0625", 100


def problem(walks: int = 1) -> tuple[NetworkProblem, NetworkState]:
    """Two legs that walk one or several times, a wall, and the earlier pose of a scanner."""
    network, state = build_network()
    wall = WallConstraint(0, 1, T_ROOT[1], np.diag([1e4, 1e2, 1e5]), np.zeros((3, 10)))
    network = replace(
        network,
        bodies=walks * network.bodies,
        walls=(wall,),
        systematic_sigma=collect_prior_sigma(list(STATED.values())),
        prior=ScannerPrior(np.array([2]), T_ROOT[2:], np.diag([1e3, 1e4, 1e4])),
    )
    return network, replace(state, paths=walks * state.paths)


def solution(equations: NetworkEquations, factors: Sequence[tuple[str, Array]] = ()) -> NetworkSolution:
    covariance = compute_network_covariance(equations).select_pairs(list_known_pairs(equations.network), slice(4))
    found = NetworkSolution(equations.state.T_root_scanner, np.zeros(3), covariance, equations)
    for source, factor in factors:
        found = found.scale_covariance(factor, source)
    return found


def predict(joint: NetworkSolution) -> _Prediction:
    assert joint.solved is not None
    return _Prediction(STATED, joint, joint.solved, list(se2.to_se3(T_ROOT)))


def stddev_of(joint: NetworkSolution) -> Array:
    """(3, 6) as a prediction states them: the axes of a scanner are turned about the vertical."""
    stddev = np.zeros((3, 6))
    for k, (T, block) in enumerate(zip(T_ROOT, joint.covariance.own, strict=True)):
        turned = T[:2, :2].T @ block[:2, :2] @ T[:2, :2]
        stddev[k, [0, 1, 5]] = np.sqrt([*np.diag(turned), block[2, 2]])
    return stddev


def test_without_a_measure_the_prediction_is_the_covariance() -> None:
    joint = solution(linearize_network(*problem()))
    np.testing.assert_allclose(predict(joint).stddev(NOTHING), stddev_of(joint), rtol=1e-9)


def test_three_times_the_walks_have_three_times_their_information_and_the_same_walls_and_priors() -> None:
    prediction = predict(solution(linearize_network(*problem())))
    tripled = stddev_of(solution(linearize_network(*problem(3))))
    longer = prediction.stddev(_Measure("", 0.0, 2 * prediction.duration))
    np.testing.assert_allclose(longer, tripled, rtol=1e-6)
    assert np.all(longer[1:, 0] < 0.99 * prediction.stddev(NOTHING)[1:, 0])


def test_compared_ranges_are_the_priors_of_the_spread_that_is_estimated_again() -> None:
    equations = linearize_network(*problem())
    better = STATED | {"north": Lidar2dUncertainty(range_bias=0.005, range_scale=0.0005)}
    sigma = estimate_systematic_sigma(equations, collect_prior_sigma(list(better.values())))
    expected = linearize_network(replace(equations.network, systematic_sigma=sigma), equations.state)
    measure = _Measure("", 0.0, uncertainty={"north": {"range_bias": 0.005, "range_scale": 0.0005}})
    found = predict(solution(equations)).stddev(measure)
    np.testing.assert_allclose(found, stddev_of(solution(expected)), rtol=1e-6)


@pytest.mark.parametrize("source", [CORRELATED_BEAMS, DIFFERENCE])
def test_errors_of_models_do_not_average_out(source: str) -> None:
    """Variances are doubled, and then 1 cm² larger, before and after; those of the root are zero."""
    equations = linearize_network(*problem())
    scattered = solution(equations, [("scatter of parts", np.full(3, 2.0))])
    position = np.maximum(np.mean(scattered.covariance.stddev[:, :2] ** 2, axis=1), np.finfo(float).tiny)
    joint = scattered.scale_covariance(np.where([False, True, True], 1 + 0.01**2 / position, 1), source)
    prediction, plain = predict(joint), predict(solution(equations))
    longer = _Measure("", 0.0, 2 * prediction.duration)
    np.testing.assert_allclose(prediction.stddev(NOTHING), stddev_of(joint), rtol=1e-9)
    found, without = (np.sum(one.stddev(longer)[1:, :2] ** 2, axis=1) for one in (prediction, plain))
    np.testing.assert_allclose(found, 2 * without + 2 * 0.01**2, rtol=1e-9)


@pytest.mark.parametrize(
    ("needed", "duration", "text"),
    [(60.6, 60, "60 s"), (4, 10, "10 s"), (119, 120, "2 min"), (140, 150, "2.5 min")],
)
def test_the_length_of_a_recording_is_a_round_number(needed: float, duration: float, text: str) -> None:
    measure = _record_longer(needed)
    assert (measure.action, measure.duration) == (f"record {text} more of people who walk like these", duration)
    assert measure.minutes == 3 + duration / 60


@cache
def calibrated(kind: str) -> Calibration:
    return solve_network(kind, SEED)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "part"), [(LARGE_ERRORS, "compare ranges of"), (SMALL_ERRORS, "record ")])
def test_the_next_calibration_has_what_a_remedy_promises(kind: str, part: str) -> None:
    """Within the limits of most remedies of the benchmark's networks."""
    seed = SEED + (kind == SMALL_ERRORS)  # of which a longer recording helps a scanner
    before = solve_network(kind, seed)
    taken = (one for one in before.evidence.remedies if one.action.startswith(part))
    remedy = min(taken, key=lambda one: one.expected / one.stddev)
    axis = KINDS["lidar2d"].axes.index(remedy.axis)
    assert before[remedy.sensor].axis_stddev[axis] == pytest.approx(remedy.stddev, rel=1e-6)
    after = solve_network(kind, seed, remedy)[remedy.sensor].axis_stddev[axis]
    assert remedy.expected < 0.9 * remedy.stddev
    assert after == pytest.approx(remedy.expected, rel=0.3)


def test_the_verdict_of_a_weak_scanner_ends_with_its_first_remedy() -> None:
    found = calibrated(LARGE_ERRORS)
    remedy = next(one for one in found.evidence.remedies if one.sensor == "scanner_4")
    verdict = found["scanner_4"].verdict
    assert verdict.grade == "weak"
    assert f"; {remedy.action}: {remedy.axis} ±" in verdict.reason
    assert "let people walk farther" not in verdict.reason


def test_the_lengths_of_recordings_are_in_the_file(tmp_path: Path) -> None:
    found = calibrated(LARGE_ERRORS)
    compared = found.evidence.remedies[0]
    longer = replace(compared, action="record", uncertainty={}, duration=30.0)
    found = replace(found, evidence=replace(found.evidence, remedies=(compared, longer)))
    save_calibration(found, tmp_path / "calibration.yaml")
    again = load_calibration(tmp_path / "calibration.yaml").evidence.remedies
    assert [str(one) for one in again] == [str(compared), str(longer)]
    assert [one.duration for one in again] == [0.0, 30.0]


def test_of_a_short_recording_no_longer_one_is_predicted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert all(one.duration == 0 for one in calibrated(LARGE_ERRORS).evidence.remedies)
    monkeypatch.setattr(remedies, "_MIN_DURATION", 10.0)
    assert any(one.duration > 0 for one in solve_network("lab 0.25", SEED).evidence.remedies)


@pytest.mark.slow
def test_large_networks_have_none_and_middle_ones_compare_the_root_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remedies, "_MAX_COMPARED", 4)
    compared = {of for one in solve_network(LARGE_ERRORS, SEED).evidence.remedies for of in one.uncertainty}
    assert compared == {"scanner_1"}
    monkeypatch.setattr(remedies, "_MAX_SCANNERS", 4)
    assert solve_network(LARGE_ERRORS, SEED).evidence.remedies == ()
