"""Identities through crossings, gaps and clutter."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from calgraph.geometry import Array
from calgraph.network.tracking.association import GATE, associate
from calgraph.network.tracking.clusters import Clusters

RATE = 15.0


def one_beam_each(scan: NDArray[np.intp], centres: Array) -> Clusters:
    """Objects of one point each."""
    index = np.arange(len(scan))
    ones = np.ones(len(scan), dtype=np.intp)
    nothing = np.zeros(len(scan))
    return Clusters(centres, index, ones, scan, scan / RATE, scan / RATE, nothing, nothing > 0)


def identities(*paths: Array, detected: NDArray[np.bool_] | None = None) -> list[list[int]]:
    """The path (S, 2) that each identity follows, scan by scan.

    Args:
        paths: places of one object a scan.
        detected: (paths, S) when they are detected; always if left out.
    """
    detected = np.ones((len(paths), len(paths[0])), dtype=bool) if detected is None else detected
    scan, path = np.nonzero(detected.T)
    found = one_beam_each(scan, np.stack(paths)[path, scan])
    return [path[members].tolist() for members in associate(found, 0.1, 0.5)]


def line(start: tuple[float, float], velocity: tuple[float, float], scans: int = 60) -> Array:
    return np.asarray(start + np.arange(scans)[:, None] / RATE * np.array(velocity))


def test_two_crossing_people_keep_their_identities() -> None:
    result = identities(line((0, 0), (1.2, 0.1)), line((4.8, 0.4), (-1.2, -0.1)))
    assert [set(path) for path in result] == [{0}, {1}]


def test_identity_survives_half_a_second_of_occlusion() -> None:
    detected = np.ones((1, 60), dtype=bool)
    detected[0, 30:38] = False
    assert [len(path) for path in identities(line((0, 0), (1.2, 0)), detected=detected)] == [52]


def test_identity_ends_after_two_seconds_of_occlusion() -> None:
    detected = np.ones((1, 90), dtype=bool)
    detected[0, 30:60] = False
    assert [len(path) for path in identities(line((0, 0), (1.2, 0), 90), detected=detected)] == [30, 30]


def test_identity_survives_occlusion_by_another_person() -> None:
    detected = np.ones((2, 60), dtype=bool)
    detected[1, 26:34] = False
    result = identities(line((0, 0), (1.2, 0)), line((4.8, 0.3), (-1.2, 0)), detected=detected)
    assert [set(path) for path in result] == [{0}, {1}]


def test_clutter_starts_no_identity(rng: np.random.Generator) -> None:
    strays = rng.uniform(-20, 20, (60, 2))
    result = identities(line((0, 0), (1.2, 0)), strays)
    assert [set(path) for path in result] == [{0}]


def test_no_objects_give_no_identity() -> None:
    assert associate(one_beam_each(np.empty(0, dtype=np.intp), np.empty((0, 2))), 0.1, 0.5) == []


def test_a_crowd_keeps_its_identities() -> None:
    count = 12
    crowd = [line((0, 1.0 * k), (1.0 + 0.05 * k, 0)) for k in range(count)]
    assert [set(path) for path in identities(*crowd)] == [{k} for k in range(count)]


@pytest.mark.parametrize(("scans", "count"), [(4, 0), (5, 1)])
def test_five_matches_confirm_an_identity(scans: int, count: int) -> None:
    assert len(identities(line((0, 0), (1.2, 0), scans))) == count


def test_the_gate_rejects_one_correct_match_in_a_thousand() -> None:
    assert pytest.approx(chi2.isf(1e-3, 2), abs=0.05) == GATE


def test_an_object_outside_the_gate_is_not_matched() -> None:
    # After two seconds the prediction is known to 0.12 m in each axis: 0.7 m is five standard deviations.
    path = line((0, 0), (0, 0), 40)
    path[35:] += [0.7, 0.0]
    assert [len(path) for path in identities(path)] == [35, 5]
