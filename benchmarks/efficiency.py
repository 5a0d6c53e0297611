"""How near estimators come to the Cramér–Rao bound, and whether their covariances hold.

python benchmarks/efficiency.py --runs 200                     # one rig, noise drawn 200 times
python benchmarks/efficiency.py --runs 50 --scenarios 4        # four rigs, 50 times each
python benchmarks/efficiency.py --runs 200 --stated 2          # rig.yaml states twice the noise that there is
python benchmarks/efficiency.py --systematic drawn             # systematic errors drawn from the priors
python benchmarks/efficiency.py --systematic exact             # none, and rig.yaml states so: uncertainty 0

The RMSE of an efficient estimator over the bound is 1 up to chance. With consistent covariances, so is the NEES
per degree of freedom, and 95 % ellipsoids contain the ground truth in 95 % of runs. Intervals are of 99 %.
Relative to the ideal estimate, which has the same noise and starts at the ground truth, chance cancels for the
most part. ``pairwise`` is the start along the spanning tree.

How long estimators take is in times.py.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, TypeVar, get_args

import numpy as np
from pydantic import BaseModel
from scipy.stats import binomtest, chi2, norm

from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.rig.bundle.board_observations import BoardObservation
from calgraph.rig.bundle.board_outlines import add_outlines
from calgraph.rig.bundle.bundle_setup import build_bundle, update_noise
from calgraph.rig.bundle.bundle_solver import linearize_bundle
from calgraph.rig.bundle.estimate import cramer_rao
from calgraph.rig.bundle.problem import Estimator, Problem, SolverOptions
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.simulation import GroundTruth, RigScenario, World, build_world
from ideal_detections import IdealDetectorOptions, simulate_detections
from model_error_draws import draw_errors
from rig_errors import ModelErrors
from simulated import poses_of
from worlds import grouped, make_parser, run_worlds

ESTIMATORS = "pairwise", *get_args(Estimator)
AXES = ("x", "y", "z", "rx", "ry", "rz")
TARGET = 0.95, 1.10
"""Of the RMSE over the bound."""
CONFIDENCE = 0.99


Uncertainty = TypeVar("Uncertainty", bound=BaseModel)


@dataclass(frozen=True, eq=False)
class Recording:
    """What a calibration gets, and the ground truth to judge it by."""

    rig: Rig
    captured: CaptureSet
    truth: GroundTruth
    noise: Rig
    """The rig with the noise that its measurements have."""

    @property
    def T_root_sensor(self) -> dict[str, Array]:
        """True poses (4, 4), the root first."""
        return {self.rig.root: self.truth.T_root_sensor[self.rig.root], **self.truth.T_root_sensor}

    @property
    def T_root_board(self) -> dict[int, Array]:
        """True poses (4, 4) of the board by capture."""
        starts, boards = np.array([board.trigger for board in self.truth.boards]), self.truth.boards
        nearest = {hold.index: int(np.argmin(np.abs(starts - hold.start))) for hold in self.captured.holds}
        return {index: boards[i].T_root_board for index, i in nearest.items()}


@dataclass(frozen=True)
class Draw:
    """What determines a recording."""

    captures: int
    stated: float
    """Stated noise over true noise."""
    systematic: str
    """Systematic errors: none, drawn, or exact."""
    world: int
    run: int
    number: int
    """Of the recording, which seeds what the estimators draw."""


@dataclass(frozen=True, eq=False)
class Row(Draw):
    """What one estimator made of one recording; arrays as of :class:`Outcomes`, without R."""

    estimators: str
    """All that have it, separated by spaces."""
    estimator: str
    sensors: str
    errors: Array
    covariances: Array
    bounds: Array
    ideal: Array


@dataclass(frozen=True, eq=False)
class Outcomes:
    """What one estimator made of R runs with S sensors besides the root; NaN where it found no pose."""

    sensors: tuple[str, ...]
    errors: Array
    """(R, S, 6) in the root's fixed axes, m and rad."""
    covariances: Array
    """(R, S, 6, 6) as it states them."""
    bounds: Array
    """(R, S, 6, 6)."""
    ideal: Array
    """(R, S, 6) errors of the ideal estimate from the same noise."""

    @property
    def ratios(self) -> Array:
        """(S, 7) RMSE over the bound along each axis, and of all together: 1 at best."""
        variances = np.diagonal(self.bounds, axis1=-2, axis2=-1)
        together = squared(self.errors, self.bounds) / 6
        relative = np.concatenate([self.errors**2 / variances, together[..., None]], axis=-1)
        return np.asarray(np.sqrt(np.nanmean(relative, axis=0)))

    @property
    def paired(self) -> tuple[Array, Array]:
        """(S, 6) RMSE over that of the ideal estimate, and by which factor chance may change it."""
        both = np.isfinite(self.errors)
        squares = np.sum(self.errors**2, axis=0, where=both)
        ideals = np.sum(self.ideal**2, axis=0, where=both)
        alike = np.sum(self.errors * self.ideal, axis=0, where=both) ** 2 / (squares * ideals)
        # Two correlated normals differ only by what they do not share (Pitman, Biometrika 1939).
        spread = norm.ppf((1 + CONFIDENCE) / 2) * np.sqrt((1 - alike) / both.sum(axis=0))
        return np.sqrt(squares / ideals), np.exp(spread)

    @property
    def nees(self) -> Array:
        """(R, S) squared Mahalanobis distance of the ground truth from the estimate."""
        return squared(self.errors, self.covariances)

    @property
    def lost(self) -> int:
        """How many poses were not found."""
        return int(np.isnan(self.errors).any(axis=-1).sum())


def main() -> None:
    """Prints ratios to the bound, NEES and coverage."""
    parser = make_parser(__doc__, jobs=1)
    parser.add_argument("--runs", type=int, default=200, help="of each rig")
    parser.add_argument("--scenarios", type=int, default=1, help="rigs")
    parser.add_argument("--captures", type=int, default=48, help="a multiple of 24")
    parser.add_argument("--stated", type=float, default=1.0, help="stated noise over true noise")
    parser.add_argument(
        "--systematic",
        choices=("none", "drawn", "exact"),
        default="none",
        help="systematic errors: none, which the estimator does not know; drawn; none, stated as exact",
    )
    parser.add_argument("--estimators", nargs="+", choices=ESTIMATORS, default=list(ESTIMATORS))
    arguments = parser.parse_args()
    captures = scenario_of(arguments.captures).captures
    print(
        f"{captures} captures, {arguments.runs} runs of {arguments.scenarios} rigs, stated noise "
        f"{arguments.stated:g} times the true one, systematic errors {arguments.systematic}"
    )
    shared = arguments.captures, arguments.stated, arguments.systematic
    work = [
        (*shared, world, run, arguments.runs * world + run, " ".join(arguments.estimators))
        for world in range(arguments.scenarios)
        for run in range(arguments.runs)
    ]
    show(collect(run_worlds(Row, measure, work, arguments, key=len(fields(Draw)) + 1)))


def scenario_of(captures: int) -> RigScenario:
    """The five-sensor rig with a number of captures, a multiple of 24."""
    samples, rest = divmod(captures, 24)
    if rest or not samples:
        raise SystemExit(f"--captures: must be a multiple of 24, got {captures}")
    return RigScenario(samples=samples)


@lru_cache(maxsize=1)
def build_stage(captures: int, world: int) -> tuple[World, Rig]:
    """A rig with its board poses, and with the noise that its measurements have."""
    stage = build_world(scenario_of(captures), world, images=False)
    return stage, simulate_detections(stage, 0, IdealDetectorOptions())[0]


def detect(draw: Draw) -> Recording:
    """Runs of a world differ in their noise only."""
    stage, noise = build_stage(draw.captures, draw.world)
    rng = np.random.default_rng((draw.world, draw.run))
    errors = draw_errors(stage, rng) if draw.systematic == "drawn" else ModelErrors()
    knobs = IdealDetectorOptions(stated_noise_factor=draw.stated)
    rig, captured, truth = simulate_detections(stage, draw.run, knobs, errors)
    if draw.systematic == "exact":
        rig, noise = without_uncertainty(rig), without_uncertainty(noise)
    return Recording(rig, captured, truth, noise)


def without_uncertainty(rig: Rig) -> Rig:
    """The rig with priors that state that nothing has a systematic error."""
    sensors = {
        name: spec.model_copy(update={"uncertainty": exact(spec.uncertainty)})
        for name, spec in rig.sensors.items()
    }
    (board,) = rig.boards
    target = board.model_copy(update={"uncertainty": exact(board.uncertainty)})
    return rig.model_copy(update={"sensors": sensors, "target": target})


def exact(uncertainty: Uncertainty) -> Uncertainty:
    """Standard deviations of zero."""
    return uncertainty.model_copy(update=dict.fromkeys(type(uncertainty).model_fields, 0.0))


def measure(*case: Any) -> list[Row]:
    """What the estimators make of one recording."""
    draw, estimators = Draw(*case[:-1]), case[-1]
    recording = detect(draw)
    rig, captured = recording.rig, recording.captured
    sensors = tuple(name for name in rig.sensors if name != rig.root)
    least = cramer_rao(recording.noise, captured, recording.T_root_sensor, recording.T_root_board)
    bounds, ideal = np.array([least[name] for name in sensors]), ideal_errors(recording)
    problem = build_problem_from_captures(rig, captured, RigOptions(), np.random.default_rng(draw.number))
    rows = []
    for name in estimators.split():
        errors, covariances = deviations(*solution(problem, name), recording.truth, sensors)
        rows.append(
            Row(
                **vars(draw),
                estimators=estimators,
                estimator=name,
                sensors=" ".join(sensors),
                errors=errors,
                covariances=covariances,
                bounds=bounds,
                ideal=ideal,
            )
        )
    return rows


def collect(rows: Sequence[Row]) -> dict[str, Outcomes]:
    """All runs by estimator."""
    return {
        name: Outcomes(
            tuple(found[0].sensors.split()),
            *(
                np.array([getattr(row, field) for row in found])
                for field in ("errors", "covariances", "bounds", "ideal")
            ),
        )
        for name, found in grouped(rows, lambda row: row.estimator)
    }


def solution(problem: Problem, estimator: str) -> tuple[Mapping[str, Array], Mapping[str, Array]]:
    """``T_root_sensor`` by sensor, and covariances (6, 6) where the estimator states them."""
    if estimator == "pairwise":
        return problem.tree.T_root_sensor, {}
    solver = SolverOptions.model_validate({**problem.solver.model_dump(), "estimator": estimator, "folds": 0})
    calibration = solve_problem(replace(problem, solver=solver))
    return poses_of(calibration), {sensor.name: sensor.covariance for sensor in calibration.sensors}


def ideal_errors(recording: Recording) -> Array:
    """(S, 6) errors of one Gauss–Newton step from the ground truth, with the true noise: no estimator is better.

    They are distributed as the bound states, but share their noise with the estimators'.
    """
    seen, T_root_sensor = recording.captured.detections, recording.T_root_sensor
    boards = [
        BoardObservation(capture, {name: 0 for name in T_root_sensor if capture in seen[name]})
        for capture in recording.T_root_board
        if any(capture in found for found in seen.values())
    ]
    bundle, start = build_bundle(recording.noise, recording.captured, boards, T_root_sensor)
    truth = replace(start, T_root_board=np.array([recording.T_root_board[board.capture] for board in boards]))
    bundle, laid = add_outlines(bundle, truth, recording.noise, recording.captured.detections, boards, 0.0)
    truth = replace(truth, extra=laid.extra)
    exact = update_noise(replace(bundle, bias_variance=np.zeros_like(bundle.bias_variance)), truth)
    H, g, _ = linearize_bundle(exact, truth).eliminate_boards()
    steps = -np.linalg.solve(H, g)[: 6 * bundle.body_count].reshape(-1, 6)
    by_name = dict(zip(bundle.sensors[1:], steps, strict=True))
    return np.array([by_name[name] for name in recording.rig.sensors if name != recording.rig.root])


def deviations(
    poses: Mapping[str, Array], stated: Mapping[str, Array], truth: GroundTruth, sensors: Sequence[str]
) -> tuple[Array, Array]:
    """Errors (S, 6) and stated covariances (S, 6, 6); NaN for sensors that were not found."""
    errors, covariances = np.full((len(sensors), 6), np.nan), np.full((len(sensors), 6, 6), np.nan)
    for i, name in enumerate(sensors):
        if name in poses:
            errors[i] = se3.difference(poses[name], truth.T_root_sensor[name])
            covariances[i] = stated.get(name, np.nan)
    return errors, covariances


def squared(errors: Array, covariances: Array) -> Array:
    """Squared Mahalanobis distances (...,) of errors (..., 6); NaN where one of the two is."""
    return np.asarray(np.sum(errors * np.linalg.solve(covariances, errors[..., None])[..., 0], axis=-1))


def show(outcomes: Mapping[str, Outcomes]) -> None:
    """Prints all tables."""
    first = next(iter(outcomes.values()))
    names, runs = first.sensors, len(first.errors)
    chance = np.sqrt(np.array(chi2.interval(CONFIDENCE, runs)) / runs)
    print(f"\nRMSE over the Cramér–Rao bound (chance along one axis: {chance[0]:.2f} to {chance[1]:.2f})")
    print(f"{'':26}" + "".join(f"{axis:>7}" for axis in (*AXES, "all")))
    for i, sensor in enumerate(names):
        for name, outcome in outcomes.items():
            print(f"{sensor:14}{name:12}" + "".join(f"{ratio:7.2f}" for ratio in outcome.ratios[i]))
    for name, outcome in outcomes.items():
        ratios = outcome.ratios[:, :6]
        met = np.sum((ratios >= TARGET[0]) & (ratios <= TARGET[1]))
        explained = np.sum((ratios >= chance[0]) & (ratios <= chance[1]))
        print(
            f"{name:12} {ratios.min():.2f} to {ratios.max():.2f}; of {ratios.size} axes {met} within "
            f"{TARGET[0]:.2f} to {TARGET[1]:.2f}, {explained} within chance of 1; {outcome.lost} poses not found"
        )
    show_paired(outcomes)
    stating = {name: outcome for name, outcome in outcomes.items() if np.isfinite(outcome.covariances).any()}
    show_nees(stating, names, runs)
    show_coverage(stating)


def show_paired(outcomes: Mapping[str, Outcomes]) -> None:
    """Prints RMSE over that of the ideal estimate."""
    print(
        "\nRMSE over that of the ideal estimate from the same noise, one Gauss–Newton step from the ground truth"
    )
    print(f"{'':26}" + "".join(f"{axis:>7}" for axis in AXES))
    for name, outcome in outcomes.items():
        ratios, factors = outcome.paired
        for sensor, row in zip(outcome.sensors, ratios, strict=True):
            print(f"{sensor:14}{name:12}" + "".join(f"{ratio:7.3f}" for ratio in row))
        print(f"{name:12} {ratios.min():.3f} to {ratios.max():.3f}; chance: up to a factor of {factors.max():.3f}")


def show_nees(outcomes: Mapping[str, Outcomes], names: Sequence[str], runs: int) -> None:
    """Prints the mean NEES by sensor."""
    low, high = np.array(chi2.interval(CONFIDENCE, 6 * runs)) / (6 * runs)
    print(f"\nMean NEES per degree of freedom (chance for one sensor: {low:.2f} to {high:.2f})")
    print(f"{'':14}" + "".join(f"{name:>13}" for name in (*names, "all")))
    for name, outcome in outcomes.items():
        means = np.append(np.nanmean(outcome.nees, axis=0), np.nanmean(outcome.nees)) / 6
        print(f"{name:14}" + "".join(f"{mean:13.3f}" for mean in means))


def show_coverage(outcomes: Mapping[str, Outcomes]) -> None:
    """Prints how often 95 % ellipsoids hold the ground truth."""
    print(f"\nShare of runs with the ground truth in the 95 % ellipsoid ({CONFIDENCE:.0%} interval of the share)")
    for name, outcome in outcomes.items():
        for i, sensor in enumerate(outcome.sensors):
            found = outcome.nees[np.isfinite(outcome.nees[:, i]), i]
            print(f"{name:12}{sensor:14} {share(found < chi2.ppf(0.95, 6))}")


def share(held: Array) -> str:
    """A share with its binomial interval, in words."""
    test = binomtest(int(held.sum()), len(held))
    interval = test.proportion_ci(CONFIDENCE)
    return f"{held.mean():6.1%} ({interval.low:.1%} to {interval.high:.1%})"


if __name__ == "__main__":
    main()
