"""Errors of a calibrated network against its ground truth, and against an earlier answer."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from calgraph.geometry import Array, se2
from calgraph.io.atomic import write_atomically
from calgraph.result import Calibration
from network_overlaps import Overlaps

GROSS_DISTANCE, GROSS_ANGLE = 0.1, np.radians(2.0)
"""Beyond either one a scanner is grossly wrong relative to its neighbours, m and rad."""


class Answer(NamedTuple):
    """The poses of a calibrated network."""

    names: tuple[str, ...]
    T_root_scanner: Array
    """(S, 3, 3) in the plane."""
    covariance: Array
    """(S, 3, 3) of the errors in x, y and yaw."""
    good: Array
    """(S,) whether the verdict is good."""


class Quality(NamedTuple):
    """Of an answer, against the ground truth."""

    connected: int
    """Scanners that have a pose."""
    connectable: int
    """Scanners to which overlaps lead from the root."""
    gross: int
    """Scanners that are grossly wrong relative to their neighbours."""
    confident: int
    """Those of them that are called good."""
    errors: Array
    """(P,) of the relative translation of each pair that overlaps, m."""


def extract_answer(found: Calibration) -> Answer:
    """The poses in a calibration."""
    rows, tangent = np.ix_((0, 1, 3), (0, 1, 3)), np.ix_((0, 1, 5), (0, 1, 5))
    return Answer(
        tuple(sensor.name for sensor in found.sensors),
        np.array([sensor.T_root_sensor[rows] for sensor in found.sensors]),
        np.array([sensor.covariance[tangent] for sensor in found.sensors]),
        np.array([sensor.verdict.grade == "good" for sensor in found.sensors]),
    )


def save_answer(path: Path, answer: Answer) -> None:
    """Writes an answer, which is small for any number of scanners."""
    with write_atomically(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **{**answer._asdict(), "names": np.array(answer.names)})


def load_answer(path: Path) -> Answer:
    """Reads an answer."""
    with np.load(path, allow_pickle=False) as content:
        return Answer(tuple(content["names"].tolist()), *(content[name] for name in Answer._fields[1:]))


def judge_answer(answer: Answer, truth: Overlaps) -> Quality:
    """Compares the poses of scanners that overlap, relative to each other, with the true ones.

    A scanner is grossly wrong if the median of its errors relative to its neighbours is beyond a limit.
    """
    place = {name: k for k, name in enumerate(answer.names)}
    both = np.array([truth.names[i] in place and truth.names[j] in place for i, j in truth.pairs], dtype=np.bool_)
    i, j = truth.pairs[both].T
    found = np.array([place.get(name, 0) for name in truth.names])
    T_estimated, T_true = (
        se2.inverse(T[a]) @ T[b]
        for T, a, b in ((answer.T_root_scanner, found[i], found[j]), (truth.T_root_sensor, i, j))
    )
    distance = np.linalg.norm(T_estimated[:, :2, 2] - T_true[:, :2, 2], axis=1)
    angle = np.abs(se2.angle(se2.inverse(T_true) @ T_estimated))
    wrong = [
        k
        for k in np.unique(truth.pairs[both])
        if np.median(distance[(i == k) | (j == k)]) > GROSS_DISTANCE
        or np.median(angle[(i == k) | (j == k)]) > GROSS_ANGLE
    ]
    return Quality(
        connected=len(answer.names),
        connectable=int(truth.connectable.sum()),
        gross=len(wrong),
        confident=int(sum(answer.good[found[k]] for k in wrong)),
        errors=distance,
    )


def compare_answers(answer: Answer, other: Answer) -> tuple[float, int]:
    """The largest difference of x, y or yaw in standard deviations of ``other``, and scanners of only one."""
    common = [name for name in answer.names if name in set(other.names)]
    here, there = ([one.names.index(name) for name in common] for one in (answer, other))
    off = se2.difference(answer.T_root_scanner[here], other.T_root_scanner[there])
    deviations = np.sqrt(np.diagonal(other.covariance[there], axis1=1, axis2=2))
    # The root has neither.
    ratios = np.abs(off) / np.where(deviations > 0, deviations, np.inf)
    return float(ratios.max(initial=0.0)), len(set(answer.names) ^ set(other.names))
