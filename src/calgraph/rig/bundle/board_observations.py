"""From matched detections to board observations: the sensors that detected one board, and its initial pose."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch
from calgraph.geometry import Array, plane, se3, so3
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.rig.pairs.board_matches import Candidates, identified_board
from calgraph.solver.connected_parts import label_parts

Node = tuple[int, str, int]
"""Capture, sensor, and index of its detection."""


@dataclass(frozen=True)
class BoardObservation:
    """One board in one capture, as detected by some sensors."""

    capture: int
    detection_index: Mapping[str, int]
    """By sensor, index of its detection."""
    unmatched: frozenset[str] = frozenset()
    """Sensors whose detection no pair has as an inlier."""


def group_detections(matches: Sequence[tuple[PairwiseEstimate, NDArray[np.bool_]]]) -> list[BoardObservation]:
    """Boards that at least two sensors detected, in order of captures.

    Args:
        matches: pairs, each with a mask (M,) of its matches to use.
    """
    edges = [
        ((int(capture), pair.sensor_a, int(i)), (int(capture), pair.sensor_b, int(j)))
        for pair, used in matches
        for capture, i, j in pair.matches[used]
    ]
    nodes: dict[Node, int] = {}
    ends = np.array([[nodes.setdefault(end, len(nodes)) for end in edge] for edge in edges], dtype=np.intp)
    ends = ends.reshape(-1, 2)
    labels = label_parts(len(nodes), ends)
    links = np.bincount(ends.ravel(), minlength=len(nodes))
    components: dict[int, list[tuple[int, Node]]] = {}
    for node, n in nodes.items():
        components.setdefault(int(labels[n]), []).append((int(links[n]), node))
    return sorted(map(_select_detections, components.values()), key=lambda o: o.capture)


def _select_detections(members: Sequence[tuple[int, Node]]) -> BoardObservation:
    """The board observation of matched detections: of several of one sensor that with the most matches."""
    ranked = sorted(members, key=lambda member: (member[0], -member[1][2]))
    return BoardObservation(ranked[0][1][0], {sensor: k for _, (_, sensor, k) in ranked})


def add_unambiguous_detections(
    boards: Sequence[BoardObservation], detections: Mapping[str, Candidates], sensors: Collection[str]
) -> list[BoardObservation]:
    """The boards with detections that no pair has as inliers, in order of captures.

    Added are detections that are the only one of a sensor in a capture, or the only one of a camera of one of the
    rig's boards. They join the board that most sensors detected in the capture, or make a new board.

    Args:
        boards: of the pairs' inliers.
        detections: of all sensors.
        sensors: whose detections are added.
    """
    by_capture: dict[int, list[BoardObservation]] = {}
    for board in boards:
        by_capture.setdefault(board.capture, []).append(board)
    for name in sensors:
        for capture, candidates in detections[name].items():
            present = by_capture.setdefault(capture, [])
            used = {board.detection_index[name] for board in present if name in board.detection_index}
            for k in set(_find_unambiguous(candidates)) - used:
                number = identified_board(candidates[k])
                fitting = [
                    i
                    for i, board in enumerate(present)
                    if name not in board.detection_index
                    and (number is None or board_number(board, detections) in (-1, number))
                ]
                i = max(fitting, key=lambda i: len(present[i].detection_index), default=len(present))
                if i == len(present):
                    present.append(BoardObservation(capture, {}))
                one = present[i]
                present[i] = replace(
                    one, detection_index={**one.detection_index, name: k}, unmatched=one.unmatched | {name}
                )
    shared = [board for _, found in sorted(by_capture.items()) for board in found]
    return [board for board in shared if len(board.detection_index) > 1]


def _find_unambiguous(candidates: Sequence[Detection]) -> list[int]:
    """Indices of the detections that are the only ones of a board, as far as the sensor identifies boards."""
    numbers = [identified_board(one) for one in candidates]
    return [k for k, number in enumerate(numbers) if numbers.count(number) == 1]


def locating_sensors(board: BoardObservation, detections: Mapping[str, Candidates]) -> frozenset[str]:
    """The sensors with inliers on a board; without any, the one whose detection determines most of its pose."""

    def rank(name: str) -> int:
        detection = detections[name][board.capture][board.detection_index[name]]
        return 2 if isinstance(detection, BoardCorners) else int(isinstance(detection, PlanePatch))

    return frozenset(board.detection_index) - board.unmatched or frozenset({max(board.detection_index, key=rank)})


def initial_board_pose(
    observation: BoardObservation, detections: Mapping[str, Candidates], T_root_sensor: Mapping[str, Array]
) -> Array:
    """Initial ``T_root_board`` (4, 4): from a camera if one detected it, else with the plane of a scanner.

    Sensors that locate the board come first; but another camera determines its pose within a scanner's plane.
    """
    locating = locating_sensors(observation, detections)
    detected = list(detections_of(observation, detections))
    cameras = [(name, d) for name, d in detected if isinstance(d, BoardCorners)]
    if cameras:
        name, best = min(cameras, key=lambda one: (one[0] not in locating, float(np.trace(one[1].covariance))))
        return np.asarray(T_root_sensor[name] @ best.T_camera_board)
    found = [(T_root_sensor[name], d) for name, d in detected if name in locating]
    points = np.concatenate([se3.apply(T, d.points) for T, d in found if not isinstance(d, BoardCorners)])
    center = points.mean(axis=0)
    patches = [(T, d) for T, d in found if isinstance(d, PlanePatch)]
    T, n = (
        (patches[0][0], patches[0][0][:3, :3] @ patches[0][1].plane[:3])
        if patches
        else (found[0][0], plane.fit(points)[:3])
    )
    n = n if n @ (T[:3, 3] - center) >= 0 else -n
    # The rotation about the normal is arbitrary; y is along the projection of the axis farthest from the normal.
    across = so3.hat(n)
    x = -across[:, np.argmin(np.abs(n))]
    x /= np.linalg.norm(x)
    return se3.pose(np.stack([x, across @ x, n], axis=-1), center)


def detections_of(
    observation: BoardObservation, detections: Mapping[str, Candidates]
) -> Iterator[tuple[str, Detection]]:
    """The sensors of a board observation with their detections."""
    return ((name, detections[name][observation.capture][k]) for name, k in observation.detection_index.items())


def board_number(observation: BoardObservation, detections: Mapping[str, Candidates]) -> int:
    """Index of the rig's board that cameras identified; -1 without one."""
    return next((d.board for _, d in detections_of(observation, detections) if isinstance(d, BoardCorners)), -1)
