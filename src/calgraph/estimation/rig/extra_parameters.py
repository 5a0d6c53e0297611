"""What a bundle may estimate besides poses: range biases, intrinsics, and the places of tags on their boards."""

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter
from typing import Literal

import numpy as np

from calgraph.config import Rig
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

# How far off values that are stated may be, as standard deviations: range biases, m; focal lengths, as a share;
# principal points, as a share of the picture; coefficients of a distortion; tags on their board, m and rad.
_BIAS, _FOCAL, _PRINCIPAL, _DISTORTION, _TAG, _TAG_ANGLE = 0.1, 0.1, 0.05, 0.3, 0.03, 0.05
_COEFFICIENTS = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
_NO_TAG = (-1, -1)
# What is known hardly better than beforehand was not measured.
_MAX_STDDEV_SHARE = 0.5

TagCorners = dict[tuple[int, int], Array]
"""Corners (4, 3) by board and id."""

_log = logging.getLogger(__name__)


def add_extra_parameters(
    bundle: Bundle, state: BundleState, rig: Rig, board_of: Index, estimate: Sequence[Estimable]
) -> tuple[Bundle, BundleState]:
    """The bundle and its start with what is to be estimated besides poses.

    Args:
        bundle: without unknowns.
        state: its start.
        rig: what the sensors saw.
        board_of: (C,) which of the rig's boards each board is; those that no camera saw may be any.
        estimate: which; the order does not matter.

    Raises:
        InputError: no sensor has such an unknown.
    """
    if "range_bias" in estimate:
        bundle = _add_range_biases(bundle)
    if "intrinsics" in estimate:
        bundle = _add_intrinsics(bundle)
    if "tags" in estimate:
        bundle = _add_tag_displacements(bundle, rig, board_of)
    return bundle, replace(state, extra=np.array([one.prior_value for one in bundle.extra_parameters]))


def summarize_extra_parameters(
    bundle: Bundle, state: BundleState, system: BundleEquations
) -> tuple[EstimatedParameter, ...]:
    """The unknowns besides poses, with their standard deviations."""
    own = np.diag(parameter_covariance(system))[6 * bundle.body_count :]
    found = tuple(
        EstimatedParameter(
            one.of,
            one.quantity,
            one.unit,
            one.prior_value,
            float(value),
            float(stddev),
            bool(stddev < _MAX_STDDEV_SHARE * one.prior_stddev),
        )
        for one, value, stddev in zip(bundle.extra_parameters, state.extra, np.sqrt(own), strict=True)
        # Where outlines are seen is a nuisance, which nobody asked for.
        if one.view_sets[0] < len(bundle.sensors)
    )
    for one in found:
        if not one.measured:
            _log.warning(
                "%s of %s is told by no capture: %.4g ± %.2g %s; do not rely on it", one.quantity, one.of,
                one.value, one.stddev, one.unit,
            )  # fmt: skip
    return found


def _add_range_biases(bundle: Bundle) -> Bundle:
    views: list[BoardViews] = list(bundle.views)
    unknowns: list[ExtraParameter] = []
    for s, own in enumerate(bundle.views):
        if isinstance(own, RangeObservations):
            views[s] = replace(own, extra_count=1)
            unknowns.append(ExtraParameter(bundle.sensors[s], "range bias", "m", 0.0, _BIAS, (s,)))
    return _extend(bundle, views, unknowns, "range_bias: no scanner")


def _add_intrinsics(bundle: Bundle) -> Bundle:
    views: list[BoardViews] = list(bundle.views)
    unknowns: list[ExtraParameter] = []
    for s, own in enumerate(bundle.views):
        if isinstance(own, CornerObservations):
            views[s] = replace(own, estimate_intrinsics=True)
            unknowns += _intrinsic_parameters(bundle.sensors[s], s, own.camera)
    return _extend(bundle, views, unknowns, "intrinsics: no camera")


def _intrinsic_parameters(name: str, sensor: int, camera: CameraModel) -> Iterator[ExtraParameter]:
    quantities = ("fx", "fy", "cx", "cy", *_COEFFICIENTS[camera.model])[: len(camera.intrinsics)]
    beliefs = [*(_FOCAL * camera.focal), _PRINCIPAL * camera.width, _PRINCIPAL * camera.height]
    beliefs += [_DISTORTION] * len(camera.distortion)
    for i, (quantity, belief) in enumerate(zip(quantities, beliefs, strict=True)):
        yield ExtraParameter(
            name, quantity, "px" if i < 4 else "", float(camera.intrinsics[i]), float(belief), (sensor,)
        )


def _add_tag_displacements(bundle: Bundle, rig: Rig, board_of: Index) -> Bundle:
    """Tags may be off their places, but one of each board, the one seen most often: it is where the board is."""
    cameras = {s: own for s, own in enumerate(bundle.views) if isinstance(own, CornerObservations)}
    printed = [_tag_corners(which, compute_landmarks(board)) for which, board in enumerate(rig.boards)]
    on = {s: _find_tags(own, board_of, printed) for s, own in cameras.items()}
    seen = Counter(key for keys in on.values() for key in keys if key != _NO_TAG)
    by_board = groupby(sorted(seen), key=itemgetter(0))
    fixed = {max(keys, key=lambda key: seen[key]) for _, keys in by_board}
    free = [key for tags in printed for key in tags if key in seen and key not in fixed]
    number = {key: i for i, key in enumerate(free)}
    centers = np.array([printed[key[0]][key].mean(axis=0)[:2] for key in free]).reshape(-1, 2)
    views: list[BoardViews] = list(bundle.views)
    for s, own in cameras.items():
        tag = np.array([number.get(key, -1) for key in on[s]], dtype=np.intp)
        views[s] = replace(own, tag_centers=centers, tag_index=tag)
    names = [f"tag {key[1]}" + (f" of board {key[0] + 1}" if len(printed) > 1 else "") for key in free]
    unknowns = [
        ExtraParameter(name, quantity, unit, 0.0, belief, tuple(cameras))
        for name in names
        for quantity, unit, belief in (("x", "m", _TAG), ("y", "m", _TAG), ("rotation", "rad", _TAG_ANGLE))
    ]
    return _extend(bundle, views, unknowns, "tags: no camera saw two tags of one board")


def _tag_corners(board: int, marks: Landmarks) -> TagCorners:
    """The tags of a board; none where its marks are single corners."""
    if marks.corners.shape[1] == 1:
        return {}
    return {(board, int(i)): corners for i, corners in zip(marks.ids, marks.corners, strict=True)}


def _find_tags(views: CornerObservations, board_of: Index, printed: Sequence[TagCorners]) -> list[tuple[int, int]]:
    """By corner, the tag that it is of; ``_NO_TAG`` for those of none."""
    places = {
        (key[0], *corner.tolist()): key for tags in printed for key, corners in tags.items() for corner in corners
    }
    board = np.repeat(board_of[views.board], np.diff(views.start, append=len(views.pixels)))
    return [
        places.get((int(b), *corner), _NO_TAG)
        for b, corner in zip(board, views.corners_board.tolist(), strict=True)
    ]


def _extend(bundle: Bundle, views: Sequence[BoardViews], unknowns: Sequence[ExtraParameter], none: str) -> Bundle:
    if not unknowns:
        raise InputError(f"--estimate {none}")
    return replace(bundle, views=tuple(views), extra_parameters=(*bundle.extra_parameters, *unknowns))
