"""Parameters that a bundle can estimate besides poses: range biases, intrinsics, displacements of tags."""

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter
from typing import Literal

import numpy as np

from calgraph.config import Rig
from calgraph.config.settings import ExtraParameterSettings
from calgraph.detection import compute_landmarks
from calgraph.detection.landmarks import Landmarks
from calgraph.errors import InputError
from calgraph.estimation.rig.bundle_solver import Bundle, BundleEquations, BundleState, ExtraParameter
from calgraph.estimation.rig.covariances import parameter_covariance
from calgraph.estimation.rig.observations import BoardViews, CornerObservations, RangeObservations
from calgraph.geometry import Array, Index
from calgraph.result import EstimatedParameter
from calgraph.sensors import CameraModel

Estimable = Literal["range_bias", "intrinsics", "tags"]

_COEFFICIENTS = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}

Tag = tuple[int, int]
"""Board and id."""
TagCorners = dict[Tag, Array]
"""Corners (4, 3) of each."""

_log = logging.getLogger(__name__)


def add_extra_parameters(
    bundle: Bundle, state: BundleState, rig: Rig, board_of: Index, estimate: Sequence[Estimable]
) -> tuple[Bundle, BundleState]:
    """The bundle and its start values with parameters to estimate besides poses.

    Args:
        bundle: without extra parameters.
        state: its start values.
        rig: with the boards as stated.
        board_of: (C,) index of the rig's board of each observed board; arbitrary where no camera detected it.
        estimate: kinds of parameters, in any order.

    Raises:
        InputError: no sensor has such a parameter.
    """
    if "range_bias" in estimate:
        bundle = _add_range_biases(bundle)
    if "intrinsics" in estimate:
        bundle = _add_intrinsics(bundle)
    if "tags" in estimate:
        bundle = _add_tag_displacements(bundle, rig, board_of)
    return bundle, replace(state, extra=np.array([one.prior_value for one in bundle.extra_parameters]))


def summarize_extra_parameters(
    bundle: Bundle, state: BundleState, equations: BundleEquations
) -> tuple[EstimatedParameter, ...]:
    """The parameters besides poses, with their standard deviations; warns of those that are not observable."""
    variances = np.diag(parameter_covariance(equations))[6 * bundle.body_count :]
    estimated = tuple(
        EstimatedParameter(
            one.of,
            one.quantity,
            one.unit,
            one.prior_value,
            float(value),
            float(stddev),
            bool(stddev < bundle.settings.parameters.max_stddev_share * one.prior_stddev),
        )
        for one, value, stddev in zip(bundle.extra_parameters, state.extra, np.sqrt(variances), strict=True)
        # Offsets of outlines are nuisance parameters.
        if one.view_sets[0] < len(bundle.sensors)
    )
    for one in estimated:
        if not one.measured:
            _log.warning(
                "%s of %s is not observable from these captures: %.4g ± %.2g %s; do not rely on it",
                one.quantity, one.of, one.value, one.stddev, one.unit,
            )  # fmt: skip
    return estimated


def _add_range_biases(bundle: Bundle) -> Bundle:
    views: list[BoardViews] = list(bundle.views)
    parameters: list[ExtraParameter] = []
    for s, observed in enumerate(bundle.views):
        if isinstance(observed, RangeObservations):
            views[s] = replace(observed, extra_count=1)
            parameters.append(
                ExtraParameter(
                    bundle.sensors[s], "range bias", "m", 0.0, bundle.settings.parameters.range_bias, (s,)
                )
            )
    return _extend(bundle, views, parameters, "range_bias: no scanner")


def _add_intrinsics(bundle: Bundle) -> Bundle:
    views: list[BoardViews] = list(bundle.views)
    parameters: list[ExtraParameter] = []
    for s, observed in enumerate(bundle.views):
        if isinstance(observed, CornerObservations):
            views[s] = replace(observed, estimate_intrinsics=True)
            parameters += _intrinsic_parameters(bundle.sensors[s], s, observed.camera, bundle.settings.parameters)
    return _extend(bundle, views, parameters, "intrinsics: no camera")


def _intrinsic_parameters(
    name: str, sensor: int, camera: CameraModel, settings: ExtraParameterSettings
) -> Iterator[ExtraParameter]:
    quantities = ("fx", "fy", "cx", "cy", *_COEFFICIENTS[camera.model])[: len(camera.intrinsics)]
    stddevs = [
        *(settings.focal_length * camera.focal),
        settings.principal_point * camera.width,
        settings.principal_point * camera.height,
    ]
    stddevs += [settings.distortion] * len(camera.distortion)
    for i, (quantity, stddev) in enumerate(zip(quantities, stddevs, strict=True)):
        yield ExtraParameter(
            name, quantity, "px" if i < 4 else "", float(camera.intrinsics[i]), float(stddev), (sensor,)
        )


def _add_tag_displacements(bundle: Bundle, rig: Rig, board_of: Index) -> Bundle:
    """All tags may be displaced but the most often detected one of each board, which defines the board's frame."""
    cameras = {s: observed for s, observed in enumerate(bundle.views) if isinstance(observed, CornerObservations)}
    printed = [_tag_corners(which, compute_landmarks(board)) for which, board in enumerate(rig.boards)]
    tags_of = {s: _find_tags(observed, board_of, printed) for s, observed in cameras.items()}
    detections = Counter(key for keys in tags_of.values() for key in keys if key)
    by_board = groupby(sorted(detections), key=itemgetter(0))
    fixed = {max(keys, key=lambda key: detections[key]) for _, keys in by_board}
    free = [key for tags in printed for key in tags if key in detections and key not in fixed]
    number: dict[Tag | None, int] = {key: i for i, key in enumerate(free)}
    centers = np.array([printed[key[0]][key].mean(axis=0)[:2] for key in free]).reshape(-1, 2)
    views: list[BoardViews] = list(bundle.views)
    for s, observed in cameras.items():
        tag = np.array([number.get(key, -1) for key in tags_of[s]], dtype=np.intp)
        views[s] = replace(observed, tag_centers=centers, tag_index=tag)
    settings = bundle.settings.parameters
    names = [f"tag {key[1]}" + (f" of board {key[0] + 1}" if len(printed) > 1 else "") for key in free]
    parameters = [
        ExtraParameter(name, quantity, unit, 0.0, stddev, tuple(cameras))
        for name in names
        for quantity, unit, stddev in (
            ("x", "m", settings.tag_position),
            ("y", "m", settings.tag_position),
            ("rotation", "rad", settings.tag_rotation),
        )
    ]
    return _extend(bundle, views, parameters, "tags: no camera detected two tags of one board")


def _tag_corners(board: int, marks: Landmarks) -> TagCorners:
    """The tags of a board; none for patterns of single corners."""
    if marks.corners.shape[1] == 1:
        return {}
    return {(board, int(i)): corners for i, corners in zip(marks.ids, marks.corners, strict=True)}


def _find_tags(views: CornerObservations, board_of: Index, printed: Sequence[TagCorners]) -> list[Tag | None]:
    """The tag of each corner; None for those of none."""
    places = {
        (key[0], *corner.tolist()): key for tags in printed for key, corners in tags.items() for corner in corners
    }
    board = np.repeat(board_of[views.board], np.diff(views.start, append=len(views.pixels)))
    return [places.get((int(b), *corner)) for b, corner in zip(board, views.corners_board.tolist(), strict=True)]


def _extend(
    bundle: Bundle, views: Sequence[BoardViews], parameters: Sequence[ExtraParameter], none: str
) -> Bundle:
    if not parameters:
        raise InputError(f"`estimate` {none}")
    return replace(bundle, views=tuple(views), extra_parameters=(*bundle.extra_parameters, *parameters))
