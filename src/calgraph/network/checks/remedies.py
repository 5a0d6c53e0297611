"""Remedies of a network: what makes its scanners certain enough, and the standard deviations that each would give.

A longer recording multiplies the information of walking people, but not that of walls and priors: what scanners
have in common, such as a scale of all ranges, stays. Ranges that were compared with a distance meter have narrower
priors, from which the spread of systematic errors is estimated again, with the same differences between scanners.
In a longer recording, it is as now: its mean square over the data that may come. So are noise and the model error.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calgraph.config import Lidar2dSpec, Lidar2dUncertainty, Rig
from calgraph.geometry import Array
from calgraph.network.checks.model_assessment import CORRELATED_BEAMS, DIFFERENCE
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.joint.planar_poses import PLANAR_AXES, NearCovariances
from calgraph.network.joint.scanner_unknowns import (
    CLOCK,
    FIRST_SYSTEMATIC,
    SCANNER_UNKNOWNS,
    collect_prior_sigma,
    compute_prior_information,
)
from calgraph.network.joint.solver import NetworkCovariance, NetworkEquations
from calgraph.network.joint.systematic_spread import estimate_systematic_sigma
from calgraph.result import Remedy
from calgraph.result.sensor_pose import stddev_along_axes
from calgraph.verdict.grades import axis_names, max_good_stddev
from calgraph.verdict.remedy_choice import choose_amount, choose_axis, choose_measures

# What a comparison of ranges with a laser distance meter (2 mm) leaves, at walls 1 m and 8 m away, averaged over a
# minute: bias, m, as the origin of the ranges is inside of the housing; and relative scale.
_COMPARED_RANGES = {"range_bias": 0.005, "range_scale": 0.0005}
# Minutes of an operator, by which remedies are ranked: for another recording, beside its duration; at a scanner.
_RECORDING_MINUTES, _COMPARISON_MINUTES = 3.0, 5.0
# Shortest recording whose walks show what as many again would give, s. Of a minute, what the next calibration
# states is 0.7 to 1.4 of the prediction; of 20 s, it is 0.4 to 1.5.
_MIN_DURATION = 50.0
# Lengths of a further recording that are considered, as multiples of the present one.
_MULTIPLES = (0.5, 1.0, 2.0, 3.0)
# Scanners of a network whose remedies are predicted: of 30, that takes a second.
_MAX_SCANNERS = 30
# Scanners of a network in which each one's own ranges are considered beside the root's; of 30, that takes 10 s, an
# eighth of the calibration.
_MAX_COMPARED = 10


@dataclass(frozen=True, eq=False)
class _Measure:
    """A remedy as a change of the joint problem."""

    action: str
    minutes: float
    duration: float = 0.0
    """Of a further recording, s."""
    uncertainty: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """By scanner, what to state in rig.yaml afterwards."""

    def __add__(self, other: "_Measure") -> "_Measure":
        return _Measure(
            f"{self.action}, and {other.action}",
            self.minutes + other.minutes,
            self.duration + other.duration,
            {**self.uncertainty, **other.uncertainty},
        )


def find_network_remedies(
    rig: Rig, joint: NetworkSolution, names: Sequence[str], T_root_sensor: Sequence[Array]
) -> tuple[Remedy, ...]:
    """Remedies of the scanners that are less certain than the tolerance, the cheapest that suffice first.

    Args:
        rig: its tolerance, and the uncertainties that it states.
        joint: the joint solution, with what was added to its covariance.
        names: of its scanners, the root first.
        T_root_sensor: poses (4, 4) of the same.
    """
    if joint.solved is None or not joint.solved.network.bodies or len(names) > _MAX_SCANNERS:
        return ()
    settings = rig.settings.diagnostics.verdict
    limits = max_good_stddev(rig.tolerance, settings)
    unobservable = np.repeat([settings.unobservable_translation_stddev, settings.unobservable_rotation_stddev], 3)
    specs = {name: spec for name, spec in rig.sensors.items() if isinstance(spec, Lidar2dSpec)}
    stated = {name: specs[name].uncertainty for name in names}
    prediction = _Prediction(stated, joint, joint.solved, T_root_sensor)
    now = prediction.stddev(_Measure("", 0.0))
    found: list[Remedy] = []
    for s in np.flatnonzero(np.any(now > limits, axis=1) & np.all(now <= unobservable, axis=1)).tolist():

        def excess(measure: _Measure, s: int = s) -> float:
            return float(np.max(prediction.stddev(measure)[s] / limits))

        compared = [names[0], names[s]] if len(names) <= _MAX_COMPARED else [names[0]]
        measures = [*_compare_ranges({name: stated[name] for name in compared})]
        if prediction.duration >= _MIN_DURATION:
            longer = [_record_longer(multiple * prediction.duration) for multiple in _MULTIPLES]
            measures.append(choose_amount(longer, excess, otherwise=longer[_MULTIPLES.index(1.0)]))
        for one in choose_measures(measures, excess, float(np.max(now[s] / limits))):
            after = prediction.stddev(one)[s]
            axis = choose_axis(now[s], after, limits)
            found.append(
                Remedy(
                    one.action, names[s], axis_names("lidar2d")[axis], "m" if axis < 3 else "rad",
                    float(now[s, axis]), float(after[axis]), bool(np.all(after <= limits)),
                    uncertainty=one.uncertainty, duration=one.duration,
                )
            )  # fmt: skip
    return tuple(found)


def _record_longer(duration: float) -> _Measure:
    step = 10 if duration <= 120 else 30
    seconds = float(step * max(round(duration / step), 1))
    length = f"{seconds / 60:g} min" if seconds >= 120 else f"{seconds:g} s"
    minutes = _RECORDING_MINUTES + seconds / 60
    return _Measure(f"record {length} more of people who walk like these", minutes, seconds)


def _compare_ranges(stated: Mapping[str, Lidar2dUncertainty]) -> Iterator[_Measure]:
    """The measures that know the ranges of a scanner better than stated."""
    for name, before in stated.items():
        better = {key: value for key, value in _COMPARED_RANGES.items() if value < before.model_dump()[key]}
        if better:
            text = f"compare ranges of {name} with a laser distance meter"
            yield _Measure(text, _COMPARISON_MINUTES, uncertainty={name: better})


class _Prediction:
    """Standard deviations along the axes of scanners after remedies."""

    def __init__(
        self,
        stated: Mapping[str, Lidar2dUncertainty],
        joint: NetworkSolution,
        equations: NetworkEquations,
        T_root_sensor: Sequence[Array],
    ) -> None:
        self._stated = stated
        self._equations, self._poses, self._factors = equations, T_root_sensor, joint.variance_factors
        self._with_bodies = equations.eliminate_bodies()[0]
        self._without = equations.H.add_diagonal(equations.regularizer).fix(~equations.estimated)
        knots = [body.knots for body in equations.network.bodies]
        self.duration = max(one.start + one.duration for one in knots) - min(one.start for one in knots)
        self._now = self._solve(equations.network.systematic_sigma, 1.0)
        self._after: dict[tuple[float, tuple[str, ...]], Array] = {}

    def stddev(self, measure: _Measure) -> Array:
        """(S, 6) along and about the axes of the scanners."""
        key = measure.duration, tuple(measure.uncertainty)
        if key not in self._after:
            sigma = self._equations.network.systematic_sigma
            if measure.uncertainty:
                better = [
                    stated.model_copy(update=dict(measure.uncertainty.get(name, {})))
                    for name, stated in self._stated.items()
                ]
                sigma = estimate_systematic_sigma(self._equations, collect_prior_sigma(better))
            covariance = self._enlarge(self._solve(sigma, 1 + measure.duration / self.duration))
            blocks = np.zeros((len(self._poses), 6, 6))
            blocks[:, PLANAR_AXES[:, None], PLANAR_AXES] = covariance.own
            stddev = [stddev_along_axes(*one) for one in zip(self._poses, blocks, strict=True)]
            self._after[key] = np.array(stddev)
        return self._after[key]

    def _solve(self, systematic_sigma: Array, multiple: float) -> NearCovariances:
        """Of each scanner's pose, for a spread (S, E) of systematic errors and a multiple of the bodies."""
        network, U = self._equations.network, SCANNER_UNKNOWNS
        own, common = compute_prior_information(systematic_sigma)
        change, by_scanner = np.zeros((network.count, U)), np.zeros((network.count, U, common.shape[-1]))
        change[:, FIRST_SYSTEMATIC:] = own - compute_prior_information(network.systematic_sigma)[0]
        by_scanner[:, FIRST_SYSTEMATIC:] = common
        entries = multiple * self._with_bodies.entries + (1 - multiple) * self._without.entries
        H = replace(self._with_bodies, entries=entries, common=by_scanner.reshape(change.size, -1))
        inverse = H.add_diagonal(change.ravel()).factor().invert()
        pairs = np.repeat(np.arange(network.count)[:, None], 2, axis=1)
        return NetworkCovariance(inverse, self._equations.estimated).select_pairs(pairs, slice(CLOCK))

    def _enlarge(self, covariance: NearCovariances) -> NearCovariances:
        """With what was added to the covariance of the solution, of which errors of models stay as they are."""
        before = self._now
        for kind, factors in self._factors:
            after = factors
            if kind in (CORRELATED_BEAMS, DIFFERENCE):
                variances = (np.mean(one.stddev[:, :2] ** 2, axis=1) for one in (before, covariance))
                stated, expected = (np.maximum(one, np.finfo(float).tiny) for one in variances)
                after = 1 + (factors - 1) * stated / expected
            before, covariance = before.scale(factors), covariance.scale(after)
        return covariance
