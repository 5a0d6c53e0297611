"""Remedies: what would make a sensor certain enough, and the standard deviations that each would give.

More captures multiply the information of the measurements, and a better known lens or print has a narrower prior:
the posterior covariance after each follows from that of the solution. Cheap remedies that suffice come first.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag

from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Board, CameraSpec, Rig, SensorSpec
from calgraph.geometry import Array, Index, diagonal_blocks
from calgraph.result import Remedy, Suggestion
from calgraph.result.sensor_pose import stddev_along_axes
from calgraph.rig.bundle.bundle_solver import Bundle
from calgraph.rig.bundle.covariances import axis_jacobian
from calgraph.rig.bundle.error_sources import group_parameters
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.rig.bundle.systematic_parameters import name_boards
from calgraph.rig.checks.drift_tests import DriftStatistics, average_drifts, list_changes
from calgraph.rig.checks.next_best_pose import predict_board_information
from calgraph.sensors.kinds.stated import RangeUncertainty
from calgraph.verdict.grades import axis_names, max_good_stddev
from calgraph.verdict.remedy_choice import choose_amount, choose_axis, choose_measures

# How well a ruler measures a print or a sheet, m: half a millimetre mark.
_RULER = 0.0005
# How well two ends on a scale of half millimetres measure the length of a print, m.
_PRINT_LENGTH = 0.0002
# What a careful calibration of a camera leaves (40 views that fill the image, of a flat board): focal length and
# pixel aspect, relative; principal point, and distortion at the image's corner, px.
_CALIBRATED_CAMERA = {"focal_length": 0.002, "pixel_aspect": 0.0005, "principal_point": 2.0, "distortion": 1.0}
# What a comparison of ranges with a tape measure at distances up to 6 m leaves: bias, m, and relative scale.
_COMPARED_RANGES = {"range_bias": 0.005, "range_scale": 0.001}
# Minutes of an operator, by which remedies are ranked: with a ruler at the board, with a tape measure at a wall,
# for a recording of a camera's views; for another recording, and for one capture in it.
_RULER_MINUTES, _TAPE_MINUTES, _CAMERA_MINUTES, _RECORDING_MINUTES, _CAPTURE_MINUTES = 2.0, 5.0, 20.0, 3.0, 0.2
# Further captures that are considered, as multiples of those recorded.
_MULTIPLES = (0.25, 0.5, 1.0, 2.0, 3.0)
# rig.yaml's key of the uncertainty that the prior of a source comes from, where its name is another one.
_KEYS: Mapping[str, str] = {
    "tag places": "tag_position",
    "board size": "size",
    "place of the print": "print_position",
}


@dataclass(frozen=True, eq=False)
class _Measure:
    """A remedy as a change of the joint problem."""

    action: str
    minutes: float
    columns: Index = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    """(m,) of the parameters that it adds information on,"""
    information: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """(m, m) and this information."""
    captures: int = 0
    """Further ones like those recorded."""
    uncertainty: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """By sensor or board, what to state in rig.yaml afterwards."""
    T_root_board: Array | None = None
    """(4, 4) of one further board."""

    def __add__(self, other: "_Measure") -> "_Measure":
        return _Measure(
            f"{self.action}, and {other.action}",
            self.minutes + other.minutes,
            np.concatenate([self.columns, other.columns]),
            block_diag(self.information, other.information),
            self.captures + other.captures,
            {**self.uncertainty, **other.uncertainty},
            other.T_root_board if self.T_root_board is None else self.T_root_board,
        )


def find_remedies(
    rig: Rig,
    solution: RigSolution,
    solved: SolvedBundle,
    drifts: DriftStatistics | None,
    suggestions: Sequence[Suggestion] = (),
) -> tuple[Remedy, ...]:
    """Remedies of the sensors that are less certain than the tolerance, the cheapest that suffice first.

    Args:
        rig: its tolerance, and the uncertainties that it states.
        solution: poses, and their covariance.
        solved: the solution of the bundle.
        drifts: their statistics; None where the covariance does not contain them.
        suggestions: board poses that help most.
    """
    settings = rig.settings.diagnostics.verdict
    limits = max_good_stddev(rig.tolerance, settings)
    unobservable = np.repeat([settings.unobservable_translation_stddev, settings.unobservable_rotation_stddev], 3)
    stddev = [stddev_along_axes(T, solution.covariance[name]) for name, T in solution.T_root_sensor.items()]
    weak = [s for s, now in enumerate(stddev) if np.any(now > limits) and np.all(now <= unobservable)]
    if not weak:
        return ()
    prediction, measures = _Prediction(solution, solved, drifts, rig), list(_list_measures(rig, solved.bundle))
    found: list[Remedy] = []
    for s in weak:
        name, before = solved.bundle.sensors[s], stddev[s]
        of_sensor = [*measures, *_list_board_pose(rig, solved, name, suggestions)]
        for one in _choose(prediction, s, limits, of_sensor, len(np.unique(solved.captures))):
            after = prediction.stddev(s, one)
            axis = choose_axis(before, after, limits)
            found.append(
                Remedy(
                    one.action, name, axis_names(rig.sensors[name].kind)[axis], "m" if axis < 3 else "rad",
                    float(before[axis]), float(after[axis]), bool(np.all(after <= limits)),
                    one.captures, one.uncertainty, one.T_root_board,
                )
            )  # fmt: skip
    return tuple(found)


class _Prediction:
    """Standard deviations along the axes of sensors after remedies."""

    def __init__(
        self, solution: RigSolution, solved: SolvedBundle, drifts: DriftStatistics | None, rig: Rig
    ) -> None:
        bundle, minimized = solved.bundle, solved.minimized
        self._solved, self._settings = solved, rig.settings.diagnostics.drifts
        self._poses = list(solution.T_root_sensor.values())
        self._axes = axis_jacobian(bundle, minimized.state)
        self._matrix = minimized.equations.eliminate_boards()[0]
        self._prior = np.diag(bundle.prior_weights(minimized.state.extra) * bundle.prior_stddev**-2)
        self._factor = drifts.serial_correlation if drifts else 1.0
        self._changes = list(list_changes(solved, drifts)) if drifts else []
        self._after: dict[int, tuple[Array, Array]] = {}

    def stddev(self, sensor: int, measure: _Measure | None = None) -> Array:
        """(6,) along and about the sensor's axes, after a remedy."""
        axes, captures = self._axes[sensor], measure.captures if measure else 0
        P, by_drifts = self._repeat_captures(captures)
        variances = np.sum((axes @ P) * axes, axis=1)
        if measure is not None and len(columns := measure.columns):
            by_columns = axes @ P[:, columns]
            ratio = np.eye(len(columns)) + measure.information @ P[np.ix_(columns, columns)]
            gain = np.linalg.solve(ratio, measure.information @ by_columns.T)
            variances = variances - np.sum(by_columns * gain.T, axis=1)
        return np.asarray(np.sqrt(self._factor * np.maximum(variances, 0) + by_drifts[sensor]))

    def _repeat_captures(self, further: int) -> tuple[Array, Array]:
        """After such captures: covariance (G, G) of the parameters, and variances (S, 6) by drifts."""
        if further not in self._after:
            multiple = 1 + further / len(np.unique(self._solved.captures))
            covariance = np.asarray(np.linalg.inv(multiple * (self._matrix - self._prior) + self._prior))
            variances = np.zeros((len(self._poses), 6))
            if self._changes:
                by_drifts = average_drifts(self._solved, self._changes, self._settings, multiple)
                blocks = zip(self._poses, diagonal_blocks(by_drifts, 6), strict=True)
                variances = np.array([stddev_along_axes(T, block) ** 2 for T, block in blocks])
            self._after[further] = covariance, variances
        return self._after[further]


def _choose(
    prediction: _Prediction, sensor: int, limits: Array, measures: Sequence[_Measure], recorded: int
) -> list[_Measure]:
    """The measures for a sensor, further captures among them."""

    def excess(measure: _Measure) -> float:
        return float(np.max(prediction.stddev(sensor, measure) / limits))

    now = float(np.max(prediction.stddev(sensor) / limits))
    more = []
    for count in (max(round(recorded * multiple), 1) for multiple in _MULTIPLES):
        minutes = _RECORDING_MINUTES + _CAPTURE_MINUTES * count
        more.append(_Measure(f"record {count} more captures like these", minutes, captures=count))
    captures = choose_amount(more, excess, otherwise=more[_MULTIPLES.index(1.0)])
    return choose_measures((captures, *measures), excess, now)


def _list_board_pose(
    rig: Rig, solved: SolvedBundle, name: str, suggestions: Sequence[Suggestion]
) -> Iterator[_Measure]:
    """The first one that is suggested for a sensor."""
    poses = [one for one in suggestions if one.sensor == name]
    if not poses:
        return
    kinds = {of: rig.sensors[of].kind for of in solved.bundle.sensors}
    (added,) = predict_board_information(solved, kinds, rig.board_size, poses[0].T_root_board[None])
    minutes = _RECORDING_MINUTES + _CAPTURE_MINUTES
    yield _Measure(poses[0].hold, minutes, added.columns, added.information, T_root_board=poses[0].T_root_board)


def _list_measures(rig: Rig, bundle: Bundle) -> Iterator[_Measure]:
    """What can be measured of boards, cameras and scanners, where that is better than what rig.yaml states."""
    for name, board in name_boards(rig):
        yield from _list_board_measures(bundle, name, board)
    for name in bundle.sensors:
        spec = rig.sensors[name]
        if isinstance(spec, CameraSpec):
            yield from _narrow(
                bundle, name, spec, _CALIBRATED_CAMERA, f"calibrate {name} by itself", _CAMERA_MINUTES
            )
        elif isinstance(spec.uncertainty, RangeUncertainty):
            text = f"compare ranges of {name} with a tape measure"
            yield from _narrow(bundle, name, spec, _COMPARED_RANGES, text, _TAPE_MINUTES)


def _list_board_measures(bundle: Bundle, name: str, board: Board) -> Iterator[_Measure]:
    sheet = {"size": _RULER, "print_position": _RULER}
    text = f"measure the outline of the {name}, and where the print is on it, to {1000 * _RULER:g} mm"
    yield from _narrow(bundle, name, board, sheet, text, _RULER_MINUTES)
    if board.pattern is None and not board.tags:
        return
    width, height = np.ptp(compute_landmarks(board).corners.reshape(-1, 3)[:, :2], axis=0).tolist()
    print_scale = {"print_scale": _PRINT_LENGTH / max(width, height)}
    aspect = {"print_aspect": _PRINT_LENGTH * np.hypot(1 / width, 1 / height)}
    text = f"measure width and height of the print on the {name} to {1000 * _PRINT_LENGTH:g} mm"
    yield from _narrow(bundle, name, board, {**print_scale, **aspect}, text, _RULER_MINUTES)
    if board.tags:
        size = min(tag.size for tag in board.tags)
        tags = {"tag_size": _PRINT_LENGTH / size, "tag_position": _RULER}
        text = f"measure sizes and places of the tags on the {name} to {1000 * _RULER:g} mm"
        yield from _narrow(bundle, name, board, tags, text, _RULER_MINUTES * len(board.tags))


def _narrow(
    bundle: Bundle, of: str, stated: Board | SensorSpec, known: Mapping[str, float], text: str, minutes: float
) -> Iterator[_Measure]:
    """The remedy of knowing some quantities this well, if that is better than stated."""
    before = stated.uncertainty.model_dump()
    better = {key: value for key, value in known.items() if 0 < value < before[key]}
    # Priors are proportional to the uncertainty that rig.yaml states.
    factor = {
        column: before[key] / better[key]
        for source, columns in group_parameters(bundle).items()
        if source.of == of and (key := _KEYS.get(source.kind, source.kind.replace(" ", "_"))) in better
        for column in columns.tolist()
    }
    if not factor:
        return
    columns = np.array(list(factor), dtype=np.intp)
    information = (np.array(list(factor.values())) ** 2 - 1) / bundle.prior_stddev[columns] ** 2
    yield _Measure(text, minutes, columns, np.diag(information), uncertainty={of: better})
