"""Identities through crossings, gaps and clutter."""

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.tracking.association import follow
from calgraph.tracking.clusters import Clusters

RATE = 15.0


def one_beam_each(scan: NDArray[np.intp], centres: Array) -> Clusters:
    """Objects of one point each."""
    index = np.arange(len(scan))
    ones = np.ones(len(scan), dtype=np.intp)
    nothing = np.zeros(len(scan))
    return Clusters(centres, index, index, ones, scan, scan / RATE, scan / RATE, nothing, nothing > 0)


def identities(*paths: Array, seen: NDArray[np.bool_] | None = None) -> list[list[int]]:
    """Which of the paths (S, 2) each identity took up, scan by scan.

    Args:
        paths: places of one object a scan.
        seen: (paths, S) when they are seen; always if left out.
    """
    seen = np.ones((len(paths), len(paths[0])), dtype=bool) if seen is None else seen
    scan, path = np.nonzero(seen.T)
    found = one_beam_each(scan, np.stack(paths)[path, scan])
    return [path[members].tolist() for members in follow(found, 0.1, 0.5)]


def line(start: tuple[float, float], velocity: tuple[float, float], scans: int = 60) -> Array:
    return np.asarray(start + np.arange(scans)[:, None] / RATE * np.array(velocity))


def test_two_who_pass_through_each_other_stay_themselves() -> None:
    result = identities(line((0, 0), (1.2, 0.1)), line((4.8, 0.4), (-1.2, -0.1)))
    assert [set(path) for path in result] == [{0}, {1}]


def test_one_hidden_for_half_a_second_is_taken_up_again() -> None:
    seen = np.ones((1, 60), dtype=bool)
    seen[0, 30:38] = False
    assert [len(path) for path in identities(line((0, 0), (1.2, 0)), seen=seen)] == [52]


def test_one_hidden_for_two_seconds_is_another() -> None:
    seen = np.ones((1, 90), dtype=bool)
    seen[0, 30:60] = False
    assert [len(path) for path in identities(line((0, 0), (1.2, 0), 90), seen=seen)] == [30, 30]


def test_one_hidden_behind_another_keeps_its_own_name() -> None:
    seen = np.ones((2, 60), dtype=bool)
    seen[1, 26:34] = False
    result = identities(line((0, 0), (1.2, 0)), line((4.8, 0.3), (-1.2, 0)), seen=seen)
    assert [set(path) for path in result] == [{0}, {1}]


def test_stray_objects_become_nobody(rng: np.random.Generator) -> None:
    strays = rng.uniform(-20, 20, (60, 2))
    result = identities(line((0, 0), (1.2, 0)), strays)
    assert [set(path) for path in result] == [{0}]


def test_nothing_is_nobody() -> None:
    assert follow(one_beam_each(np.empty(0, dtype=np.intp), np.empty((0, 2))), 0.1, 0.5) == []


def test_a_crowd_stays_apart() -> None:
    count = 12
    crowd = [line((0, 1.0 * k), (1.0 + 0.05 * k, 0)) for k in range(count)]
    assert [set(path) for path in identities(*crowd)] == [{k} for k in range(count)]
