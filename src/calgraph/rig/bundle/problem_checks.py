"""Checks of the numbers of a problem, which another program may have written: measurements, poses, cameras."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from pydantic import ValidationError
from pydantic_core import PydanticCustomError

from calgraph.config import Intrinsics
from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.result.covariance_checks import check_semidefinite, check_symmetric
from calgraph.result.frame_tree import MAX_DISTANCE
from calgraph.rig.bundle.priors import PosePrior, RigidGroup, has_inverse
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.detection_tables import DETECTIONS
from calgraph.sensors import CameraModel

# Rounding of unit vectors and rotations that other programs write with seven digits.
_UNIT_TOLERANCE = 1e-6
# By which eigenvalues of an information matrix may be negative, relative to the largest: it may be singular.
_EIGENVALUE_TOLERANCE = 1e-6
# Pixels: fifteen times the width of the largest sensors.
_MAX_PIXEL = 1e6


def check_numbers(
    captures: CaptureSet,
    estimates: Sequence[PairwiseEstimate],
    tree: SpanningTree,
    priors: Sequence[PosePrior],
    groups: Sequence[RigidGroup],
) -> None:
    """Checks the numbers of the parts of a problem.

    Raises:
        InputError: naming the column, and the sensor or pair, of values that are none of what they stand for.
    """
    _refuse("start: must be a time in s", not np.isfinite(captures.start))
    _refuse("holds/index: must differ", len({hold.index for hold in captures.holds}) < len(captures.holds))
    for hold in captures.holds:
        times = np.concatenate([[hold.start, hold.end], *hold.stamps.values()])
        _refuse(f"holds and stamps: of capture {hold.index} must be times in s", not np.isfinite(times).all())
    for name, camera in captures.cameras.items():
        _check_camera(name, camera)
    for where, field, values in _list_fields(captures):
        is_valid, meaning = _FIELDS[field]
        _refuse(f"{where} must be {meaning}", not is_valid(values))
        if field.endswith("covariance"):
            _check_covariance(where, values)
    for estimate in estimates:
        _check_estimate(estimate)
    for name, T in tree.T_root_sensor.items():
        _refuse(f"tree/T_root_sensor: of {name} must be {_POSE}", not _is_pose(T))
    for prior in priors:
        _refuse(f"priors: of {prior.sensor} must be {_POSE}", not _is_pose(np.array(prior.T_root_sensor)))
        _refuse(f"priors: of {prior.sensor} must have a covariance", not has_inverse(np.array(prior.covariance)))
    for group in groups:
        for name, rows in group.T_group_sensor.items():
            _refuse(f"groups: of {name} must be {_POSE}", not _is_pose(np.array(rows)))


def _refuse(message: str, wrong: bool) -> None:
    if wrong:
        raise InputError(message)


def _list_fields(captures: CaptureSet) -> Iterator[tuple[str, str, Array]]:
    """Place in the file, name, and value of every field of the detections that has a check."""
    for name, by_capture in captures.detections.items():
        for capture, candidates in by_capture.items():
            for found in candidates:
                table = DETECTIONS[type(found)].name
                for field, value in vars(found).items():
                    if field in _FIELDS:
                        yield f"{table}/{field}: of {name} in capture {capture}", field, np.asarray(value)


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
