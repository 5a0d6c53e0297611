"""Returns detections that are outliers of pairs but agree with the bundle, which knows systematic errors.

RANSAC finds the inliers of a pair with sensors and boards as rig.yaml states them. Where a lens, a print or a
scanner is wrong, it rejects captures that the bundle explains by its systematic parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import BoardCorners, PlanePatch
from calgraph.config import Rig
from calgraph.geometry import Index
from calgraph.rig.bundle.board_observations import (
    BoardObservation,
    Node,
    add_unambiguous_detections,
    initial_board_pose,
)
from calgraph.rig.bundle.bundle_setup import rebuild_bundle
from calgraph.rig.bundle.bundle_solver import (
    COARSE_TOLERANCE,
    Bundle,
    BundleState,
    MinimizedBundle,
    minimize_bundle,
)
from calgraph.rig.bundle.settling import select_views, settle_variances
from calgraph.rig.captures.detect import CaptureSet


@dataclass(frozen=True, eq=False)
class SettledBundle:
    """A bundle of some of the views of boards, its solution, and the boards."""

    bundle: Bundle
    """Of the views that are kept."""
    solution: MinimizedBundle
    boards: Sequence[BoardObservation]
    """(C,) as detected, with views that are not kept."""

    def nodes(self) -> set[Node]:
        """The detections that are kept."""
        return {
            (self.boards[i].capture, name, self.boards[i].detection_index[name])
            for name, views in zip(self.bundle.sensors, self.bundle.views, strict=True)
            for i in views.board.tolist()
        }


# Rounds of solving, estimating noise and rejecting views, without outlines: 11 of 12 simulated rigs converge in 2
# to 5.
MAX_ROUNDS = 24


def return_excluded_views(settled: SettledBundle, rig: Rig, captured: CaptureSet) -> SettledBundle:
    """The settled bundle with the unambiguous detections that agree with it although no pair has them as inliers.

    Views are judged as those that the bundle itself rejects: by the Mahalanobis distance from their prediction,
    after noise and view bias have settled with those that returned. A board without views in the bundle is located
    by one of its detections, and the others are judged by it.

    Args:
        settled: the bundle of the pairs' inliers, without outlines.
        rig: the rig.
        captured: all detections.
    """
    located = [
        name for name, views in zip(settled.bundle.sensors, settled.bundle.views, strict=True) if len(views.board)
    ]
    boards = add_unambiguous_detections(settled.boards, captured.detections, located)
    if _count_detections(boards) == _count_detections(settled.boards):
        return settled
    before = settled.nodes()
    complete, start = rebuild_bundle(rig, captured, boards, settled.bundle, settled.solution.state)
    chosen = _choose_detections(boards, before, captured)
    kept = _select_at_first(complete, boards, before | chosen)
    start = _start_at_detections(complete, start, boards, chosen, captured)
    solution = minimize_bundle(
        select_views(complete, complete, start, kept), start, tolerance=COARSE_TOLERANCE, exact=False
    )
    bundle, solution, after = settle_variances(complete, solution, MAX_ROUNDS, kept=kept)
    if not any(np.any(new & ~old) for new, old in zip(after, kept, strict=True)):
        return settled
    return _drop_single_views(SettledBundle(bundle, solution, boards), before)


def _count_detections(boards: Sequence[BoardObservation]) -> int:
    return sum(len(board.detection_index) for board in boards)


def _choose_detections(boards: Sequence[BoardObservation], before: set[Node], captured: CaptureSet) -> set[Node]:
    """One detection of each board that has none in the bundle: that which determines most of its pose."""
    chosen = set()
    for board in boards:
        nodes = _nodes(board)
        if before.isdisjoint(nodes):
            chosen.add(max(nodes, key=lambda node: _rank(captured, node)))
    return chosen


def _nodes(board: BoardObservation) -> list[Node]:
    return [(board.capture, name, k) for name, k in board.detection_index.items()]


def _select_at_first(
    complete: Bundle, boards: Sequence[BoardObservation], chosen: set[Node]
) -> list[NDArray[np.bool_]]:
    """(S,) masks (V,) of the views that are part of the bundle at first."""
    return [
        np.array(
            [(boards[i].capture, name, boards[i].detection_index[name]) in chosen for i in views.board.tolist()],
            dtype=np.bool_,
        )
        for name, views in zip(complete.sensors, complete.views, strict=True)
    ]


def _start_at_detections(
    complete: Bundle,
    start: BundleState,
    boards: Sequence[BoardObservation],
    chosen: set[Node],
    captured: CaptureSet,
) -> BundleState:
    """Start values with boards at their chosen detections, from which the others may be metres away."""
    T_root_sensor = dict(zip(complete.sensors, start.T_root_sensor, strict=True))
    T_root_board = start.T_root_board.copy()
    for i, board in enumerate(boards):
        for capture, name, k in chosen.intersection(_nodes(board)):
            alone = BoardObservation(capture, {name: k})
            T_root_board[i] = initial_board_pose(alone, captured.detections, T_root_sensor)
    return replace(start, T_root_board=T_root_board)


def _rank(captured: CaptureSet, node: Node) -> int:
    """How much of the board's pose a detection determines."""
    capture, name, k = node
    detection = captured.detections[name][capture][k]
    return 2 if isinstance(detection, BoardCorners) else int(isinstance(detection, PlanePatch))


def _drop_single_views(settled: SettledBundle, before: set[Node]) -> SettledBundle:
    """The bundle without the boards that one detection located, and that no other agrees with."""
    bundle, state = settled.bundle, settled.solution.state
    count = np.bincount(np.concatenate([views.board for views in bundle.views]), minlength=len(settled.boards))
    old = [
        any((board.capture, name, k) in before for name, k in board.detection_index.items())
        for board in settled.boards
    ]
    useful = (count > 1) | ((count > 0) & np.array(old, dtype=np.bool_))
    number: Index = np.cumsum(useful) - 1
    views = []
    for of_sensor in bundle.views:
        some = of_sensor.select(useful[of_sensor.board])
        views.append(replace(some, board=number[some.board]))
    nodes = settled.nodes()
    boards = [
        BoardObservation(
            board.capture,
            {name: k for name, k in board.detection_index.items() if (board.capture, name, k) in nodes},
        )
        for board, keep in zip(settled.boards, useful, strict=True)
        if keep
    ]
    state = replace(state, T_root_board=state.T_root_board[useful])
    bundle = bundle.with_views(views)
    solution = minimize_bundle(bundle, state, tolerance=COARSE_TOLERANCE, exact=False)
    return SettledBundle(bundle, solution, boards)
