"""From detections that agree to a bundle: which sensors saw one board together, and where it was about."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calgraph.detection import BoardCorners, Detection, PlanePatch
from calgraph.geometry import Array, plane, se3, so3
from calgraph.pairwise import Candidates, PairwiseEstimate

Node = tuple[int, str, int]
"""Capture, sensor, and which of its detections."""


@dataclass(frozen=True)
class BoardObservation:
    """One board in one capture, as some sensors saw it."""

    capture: int
    detection_index: Mapping[str, int]
    """By sensor, which of its detections."""


def group_detections(matches: Sequence[tuple[PairwiseEstimate, NDArray[np.bool_]]]) -> list[BoardObservation]:
    """Boards that at least two sensors saw together, in order of captures.

    Args:
        matches: pairs, each with those of its matches (M,) that are believed.
    """
    edges = [
        ((int(capture), pair.sensor_a, int(i)), (int(capture), pair.sensor_b, int(j)))
        for pair, believed in matches
        for capture, i, j in pair.matches[believed]
    ]
    nodes: dict[Node, int] = {}
    ends = np.array([[nodes.setdefault(end, len(nodes)) for end in edge] for edge in edges], dtype=np.intp)
    ends = ends.reshape(-1, 2)
    adjacency = coo_array((np.ones(len(ends)), ends.T), shape=(len(nodes), len(nodes)))
    labels = connected_components(adjacency, directed=False)[1]
    links = np.bincount(ends.ravel(), minlength=len(nodes))
    together: dict[int, list[tuple[int, Node]]] = {}
    for node, n in nodes.items():
        together.setdefault(int(labels[n]), []).append((int(links[n]), node))
    found = [_select_detections(members) for members in together.values()]
    return sorted((s for s in found if len(s.detection_index) > 1), key=lambda s: s.capture)


def _select_detections(members: Sequence[tuple[int, Node]]) -> BoardObservation:
    """Of several detections of one sensor the one that most others agree with."""
    ranked = sorted(members, key=lambda member: (member[0], -member[1][2]))
    return BoardObservation(ranked[0][1][0], {sensor: k for _, (_, sensor, k) in ranked})


def initial_board_pose(
    sighting: BoardObservation, detections: Mapping[str, Candidates], T_root_sensor: Mapping[str, Array]
) -> Array:
    """``T_root_board`` (4, 4) about where the sensors saw it: by a camera if one did, else in its plane."""
    found = [(T_root_sensor[name], d) for name, d in detections_of(sighting, detections)]
    cameras = [(T, d) for T, d in found if isinstance(d, BoardCorners)]
    if cameras:
        T, best = min(cameras, key=lambda seen: float(np.trace(seen[1].covariance)))
        return np.asarray(T @ best.T_camera_board)
    points = np.concatenate([se3.apply(T, d.points) for T, d in found if not isinstance(d, BoardCorners)])
    center = points.mean(axis=0)
    patches = [(T, d) for T, d in found if isinstance(d, PlanePatch)]
    T, n = (
        (patches[0][0], patches[0][0][:3, :3] @ patches[0][1].plane[:3])
        if patches
        else (found[0][0], plane.fit(points)[:3])
    )
    n = n if n @ (T[:3, 3] - center) >= 0 else -n
    # The board's y as far as its plane allows along the axis across it: what sensors see does not depend on it.
    across = so3.hat(n)
    x = -across[:, np.argmin(np.abs(n))]
    x /= np.linalg.norm(x)
    return se3.pose(np.stack([x, across @ x, n], axis=-1), center)


def detections_of(
    sighting: BoardObservation, detections: Mapping[str, Candidates]
) -> Iterator[tuple[str, Detection]]:
    """The sensors of a sighting with what they saw."""
    return ((name, detections[name][sighting.capture][k]) for name, k in sighting.detection_index.items())
