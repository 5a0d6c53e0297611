"""The joint problem of a rig: all inputs of its joint solution."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, ValidationError
from pydantic_core import PydanticCustomError

from calgraph.boards.detections import BoardCorners, Detection
from calgraph.config import Intrinsics, Rig
from calgraph.config.settings import MatchFilter
from calgraph.errors import CalibrationError, InputError
from calgraph.geometry import Array
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.io.strict_model import StrictModel
from calgraph.result.covariance_entries import check_semidefinite, check_symmetric
from calgraph.result.extrinsics_file import PriorFile, has_inverse
from calgraph.result.frame_tree import MAX_DISTANCE
from calgraph.rig.bundle.priors import PosePrior, RigidFile, RigidGroup, resolve_prior_poses
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.detection_tables import DETECTIONS
from calgraph.rig.pairs.board_matches import Candidates
from calgraph.rig.pairs.board_pair import PairwiseEstimates, select_successful
from calgraph.sensors import CameraModel


@contextmanager
def explain_singular_equations() -> Iterator[None]:
    """Converts errors of linear algebra into one that states their usual cause; also a decorator.

    Raises:
        CalibrationError: equations are singular in floating point.
    """
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise CalibrationError(
            "the equations of the joint solution are singular: the views of a board in some capture do not "
            "determine its pose; record more captures with other poses of the board, or leave out sensors that "
            f"detect it at its edge ({error})"
        ) from error


Estimator = Literal["bundle", "hypergraph"]


class SolverOptions(StrictModel):
    """How to solve a problem."""

    estimator: Estimator = "bundle"
    """The bundle over all sensors and boards, or the paper's hypergraph."""
    keep: MatchFilter = "ransac"
    """Matches of two sensors to use: inliers (ransac), or all (none)."""
    folds: Annotated[int, Field(ge=0)] = 5
    """Folds of the cross-validation over captures; 0 for none."""
    priors: tuple[PosePrior, ...] = ()
    """Priors of sensors' poses."""
    groups: tuple[RigidGroup, ...] = ()
    """Sensors with exact relative poses."""


@dataclass(frozen=True, eq=False)
class Problem:
    """The detections of a rig's sensors, and the start values of a joint solution.

    :func:`calgraph.save_problem` keeps it to the last bit.
    """

    rig: Rig
    captures: CaptureSet
    """All detections, and the reasons for missing ones."""
    pairs: PairwiseEstimates
    """By pair of sensors, the estimate or why it was rejected."""
    tree: SpanningTree
    """The sensors connected to the root, and their start poses."""
    solver: SolverOptions


def with_prior_poses(problem: Problem, prior: PriorFile | None, rigid: Sequence[RigidFile]) -> Problem:
    """The problem with priors and rigid groups from files instead of those that it has, if any are given.

    Raises:
        InputError: as :func:`resolve_prior_poses` does.
    """
    if prior is None and not rigid:
        return problem
    priors, groups = resolve_prior_poses(problem.rig, problem.captures, prior, rigid)
    return replace(problem, solver=problem.solver.model_copy(update={"priors": priors, "groups": groups}))


def check_problem(problem: Problem) -> None:
    """Checks the consistency of a problem, which another program may have written.

    Raises:
        InputError: naming the inconsistent part.
    """
    captures, tree, sensors = problem.captures, problem.tree, problem.rig.sensors
    if set(captures.detections) != set(sensors) or set(captures.frames) != set(sensors):
        raise InputError(f"sensors and frames: must be those of the rig, {', '.join(sensors)}")
    # A camera whose intrinsics could not be estimated has none, and no detections.
    used = {name for name in problem.rig.cameras() if captures.detections[name]}
    if not used <= set(captures.cameras) <= set(problem.rig.cameras()):
        raise InputError(f"cameras: must be those of the rig, {', '.join(problem.rig.cameras())}")
    _check_names("misses", (name for _, name in captures.rejections), sensors)
    _check_names("findings", chain.from_iterable(finding.sensors for finding in captures.findings), sensors)
    _check_names("pairs", chain.from_iterable(problem.pairs), sensors)
    _check_names("parents", tree.parents.values(), tree.T_root_sensor)
    if {tree.root, *tree.parents} != set(tree.T_root_sensor) or tree.root in tree.parents:
        raise InputError(f"parents: must be given for all sensors in the tree but its root {tree.root}")
    for hold in captures.holds:
        for name, by_capture in captures.detections.items():
            if hold.index not in by_capture and (hold.index, name) not in captures.rejections:
                raise InputError(f"misses: must state why {name} has no detection in capture {hold.index}")
    for estimate in select_successful(problem.pairs):
        _check_matches(estimate, captures.detections)
    _check_numbers(problem)


def _check_names(what: str, names: Iterable[str], allowed: Iterable[str]) -> None:
    unknown = set(names) - set(allowed)
    if unknown:
        raise InputError(f"{what}: must be among {', '.join(allowed)}, got {', '.join(sorted(unknown))}")


def _check_matches(estimate: PairwiseEstimate, detections: Mapping[str, Candidates]) -> None:
    pair = f"the pair {estimate.sensor_a}, {estimate.sensor_b}"
    if not len(estimate.matches) == len(estimate.inliers) == len(estimate.residuals):
        raise InputError(f"estimates: matches, inliers and residuals of {pair} must be as many")
    for name, column in ((estimate.sensor_a, 1), (estimate.sensor_b, 2)):
        by_capture = detections[name]
        for capture, candidate in estimate.matches[:, [0, column]].tolist():
            if not 0 <= candidate < len(by_capture.get(capture, ())):
                raise InputError(
                    f"estimates/matches: of {pair} name detection {candidate} of {name} in capture {capture}, "
                    "which does not exist"
                )


# Rounding of unit vectors and rotations that other programs write with seven digits.
_UNIT_TOLERANCE = 1e-6
# By which eigenvalues of an information matrix may be negative, relative to the largest: it may be singular.
_EIGENVALUE_TOLERANCE = 1e-6
# Pixels: fifteen times the width of the largest sensors.
_MAX_PIXEL = 1e6


def _check_numbers(problem: Problem) -> None:
    """Raises InputError for values that are none of what they stand for."""
    captures, solver = problem.captures, problem.solver
    _refuse("start: must be a time in s", not np.isfinite(captures.start))
    _refuse("holds/index: must differ", len({hold.index for hold in captures.holds}) < len(captures.holds))
    for hold in captures.holds:
        times = np.concatenate([[hold.start, hold.end], *hold.stamps.values()])
        _refuse(f"holds and stamps: of capture {hold.index} must be times in s", not np.isfinite(times).all())
    for name, camera in captures.cameras.items():
        _check_camera(name, camera)
    board_count = len(problem.rig.boards)
    for place, found in _list_detections(captures):
        if isinstance(found, BoardCorners):
            wrong = f"corners/board: {place} must be below the {board_count} boards, got {found.board}"
            _refuse(wrong, not 0 <= found.board < board_count)
            # Corners without extent in the image determine no pose.
            differ = np.isfinite(found.pixels).all() and np.ptp(found.pixels, axis=0).any()
            _refuse(f"corners/pixels: {place} must be finite and differ from each other", not differ)
        for field, value in vars(found).items():
            if field in _FIELDS:
                where, values = f"{DETECTIONS[type(found)].name}/{field}: {place}", np.asarray(value)
                is_valid, meaning = _FIELDS[field]
                _refuse(f"{where} must be {meaning}", not is_valid(values))
                if field.endswith("covariance"):
                    _check_covariance(where, values)
    for estimate in select_successful(problem.pairs):
        _check_estimate(estimate)
    for name, T in problem.tree.T_root_sensor.items():
        _refuse(f"tree/T_root_sensor: of {name} must be {_POSE}", not _is_pose(T))
    for prior in solver.priors:
        _refuse(f"priors: of {prior.sensor} must be {_POSE}", not _is_pose(np.array(prior.T_root_sensor)))
        _refuse(f"priors: of {prior.sensor} must have a covariance", not has_inverse(np.array(prior.covariance)))
    for group in solver.groups:
        for name, rows in group.T_group_sensor.items():
            _refuse(f"groups: of {name} must be {_POSE}", not _is_pose(np.array(rows)))


def _refuse(message: str, wrong: bool) -> None:
    if wrong:
        raise InputError(message)


def _list_detections(captures: CaptureSet) -> Iterator[tuple[str, Detection]]:
    """All detections, and of which sensor and capture each is."""
    for name, by_capture in captures.detections.items():
        for capture, candidates in by_capture.items():
            for found in candidates:
                yield f"of {name} in capture {capture}", found


def _check_camera(name: str, camera: CameraModel) -> None:
    try:
        same = Intrinsics.from_camera(camera).to_camera().K
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"cameras: {first['loc'][0]} of {name}: {first['msg']}, got {first['input']}") from error
    _refuse(f"cameras/K: of {name} must be fx, 0, cx; 0, fy, cy; 0, 0, 1", not np.array_equal(same, camera.K))


def _check_estimate(estimate: PairwiseEstimate) -> None:
    pair = f"the pair {estimate.sensor_a}, {estimate.sensor_b}"
    _refuse(f"estimates/T_a_b: of {pair} must be {_POSE}", not _is_pose(estimate.T_a_b))
    _refuse(
        f"estimates/information: of {pair} must be positive semidefinite",
        not _is_information(estimate.information),
    )
    _refuse(f"estimates/residuals: of {pair} must be distances in m", not _are_distances(estimate.residuals))
    _refuse(f"estimates/inliers: of {pair} must be true for a match at least", not estimate.inliers.any())


def _check_covariance(where: str, covariance: Array) -> None:
    _refuse(f"{where} must have variances of 0 or more on its diagonal", bool((np.diag(covariance) < 0).any()))
    try:
        check_symmetric(covariance, "")
        check_semidefinite(covariance, "")
    except PydanticCustomError as error:
        raise InputError(f"{where} {(error.context or {})['message']}") from error


def _within(limit: float) -> Callable[[Array], bool]:
    """Whether all values are numbers of at most a limit."""
    return lambda values: bool((np.abs(values) <= limit).all())


def _are_distances(values: Array) -> bool:
    return bool(((values >= 0) & (values <= MAX_DISTANCE)).all())


def _are_ranges(values: Array) -> bool:
    return bool(((values > 0) & (values <= MAX_DISTANCE)).all())


def _are_unit_vectors(values: Array) -> bool:
    """Whether values (..., 3) have the length 1."""
    return _within(2.0)(values) and bool((np.abs(np.linalg.norm(values, axis=-1) - 1) < _UNIT_TOLERANCE).all())


def _is_plane(values: Array) -> bool:
    return _are_unit_vectors(values[:3]) and _within(MAX_DISTANCE)(values[3])


def _is_pose(T: Array) -> bool:
    R = T[:3, :3]
    return (
        _within(2.0)(R)
        and _within(MAX_DISTANCE)(T[:3, 3])
        and np.array_equal(T[3], (0, 0, 0, 1))
        and bool(np.abs(R @ R.T - np.eye(3)).max() < _UNIT_TOLERANCE)
        and bool(np.linalg.det(R) > 0)
    )


def _is_information(information: Array) -> bool:
    if not np.isfinite(information).all():
        return False
    largest = float(np.abs(information).max())
    if largest == 0:
        return True
    scaled = information / largest
    is_symmetric = np.abs(scaled - scaled.T).max() <= _EIGENVALUE_TOLERANCE
    return bool(is_symmetric and np.linalg.eigvalsh(scaled)[0] >= -_EIGENVALUE_TOLERANCE)


_POSE = "a rotation and a translation, 4 x 4"
_PLACE = _within(MAX_DISTANCE), f"coordinates in m, {MAX_DISTANCE:g} or less"
_SCORE = _within(MAX_DISTANCE), "a number"
_UNIT = _are_unit_vectors, "unit vectors"
_FINITE = _within(MAX_DISTANCE), "finite"
_FIELDS: Mapping[str, tuple[Callable[[Array], bool], str]] = {
    "ranges": (_are_ranges, f"distances in m above 0, {MAX_DISTANCE:g} or less"),
    "directions": _UNIT,
    "edges": _UNIT,
    "plane": (_is_plane, "a unit normal and an offset in m"),
    "center": _PLACE,
    "endpoints": _PLACE,
    "corners_board": _PLACE,
    "pixels": (_within(_MAX_PIXEL), f"coordinates in pixels, {_MAX_PIXEL:g} or less"),
    "T_camera_board": (_is_pose, _POSE),
    "covariance": _FINITE,
    "plane_covariance": _FINITE,
    "match": _SCORE,
    "rms": (_are_distances, "a number of 0 or more"),
    "times": _FINITE,
    "twist": _FINITE,
}
"""By field of a detection, whether its values are what it stands for, and what that is."""
