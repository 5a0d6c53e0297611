"""Residuals of a network's beams: in metres, by scanner, without outliers."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.network.checks.assemble import _MAX_BEAMS, collect_beam_views
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.joint.problem import BodyScans
from calgraph.network.joint.solver import NetworkEquations
from dense_covariances import relate_all
from network_scenes import SIGMA
from solved_networks import replace_bodies, solve_two_walks

NAMES = ("west", "east", "north")
START = 100.0


@pytest.fixture(scope="module")
def joint() -> NetworkSolution:
    solved = solve_two_walks(np.random.default_rng(0))
    return as_solution(solved)


def as_solution(solved: NetworkEquations) -> NetworkSolution:
    state = solved.state
    return NetworkSolution(state.T_root_scanner, state.clock_offset, relate_all(np.eye(12), 3), solved)


def test_the_rms_is_the_noise_of_ranges(joint: NetworkSolution) -> None:
    _, fit = collect_beam_views(joint, NAMES, START)
    assert set(fit) == set(NAMES)
    for one in fit.values():
        assert one.unit == "m"
        assert 0.8 * SIGMA < one.rms < 1.2 * SIGMA


def test_a_range_that_is_too_long_has_a_positive_residual(joint: NetworkSolution) -> None:
    assert joint.solved is not None

    def lengthen(scans: BodyScans) -> BodyScans:
        return replace(scans, ranges=scans.ranges + (0.1 if scans.scanner == 1 else 0.0))

    problem = joint.solved.network
    bodies = tuple(replace(body, scans=tuple(map(lengthen, body.scans))) for body in problem.bodies)
    longer = replace(joint, solved=replace_bodies(joint.solved, bodies))
    views, _ = collect_beam_views(longer, NAMES, START)
    means = {view.sensor: float(np.mean(view.residuals)) for view in views}
    assert means["east"] == pytest.approx(0.1, abs=0.01)
    assert abs(means["west"]) < 0.01


def test_times_are_of_the_roots_clock_from_the_start(joint: NetworkSolution) -> None:
    assert joint.solved is not None
    late = replace(joint, clock_offset=np.array([0.0, 2.5, 0.0]))
    (_, east, _), _ = collect_beam_views(late, NAMES, START)
    (_, before, _), _ = collect_beam_views(replace(joint, clock_offset=np.zeros(3)), NAMES, START)
    np.testing.assert_allclose(east.times, before.times - 2.5)
    earliest = min(scans.times[0] for body in joint.solved.network.bodies for scans in body.scans)
    assert min(before.times) == pytest.approx(earliest - START, abs=0.5)
    assert (np.diff(before.times) >= 0).all()


def test_outliers_are_left_out_and_beams_thinned(joint: NetworkSolution) -> None:
    assert joint.solved is not None

    def reject(scans: BodyScans) -> BodyScans:
        return replace(scans, weight=np.where(np.arange(len(scans.weight)) % 2, scans.weight, 0.0))

    problem = joint.solved.network
    bodies = tuple(replace(body, scans=tuple(map(reject, body.scans))) for body in problem.bodies)
    half = replace(joint, solved=replace_bodies(joint.solved, bodies))
    views, fit = collect_beam_views(half, NAMES, START)
    _, whole = collect_beam_views(joint, NAMES, START)
    for view in views:
        assert fit[view.sensor].count == pytest.approx(whole[view.sensor].count / 2, rel=0.1)
        assert len(view.times) <= _MAX_BEAMS
        assert len(view.times) == len(view.points) == len(view.residuals)


def test_a_solution_without_its_problem_has_none(joint: NetworkSolution) -> None:
    assert collect_beam_views(replace(joint, solved=None), NAMES, START) == ((), {})
