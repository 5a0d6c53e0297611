"""Errors of a calibrated network against its ground truth.

Scanners overlap that observe the same people simultaneously: a person in range and field of view is observed where
no wall or furniture hides the middle of the body. That other people may hide it is left out.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from calgraph.geometry import Array, se2
from calgraph.io.yaml_reading import read_yaml
from calgraph.result import Calibration
from calgraph.simulation import GroundTruth, NetworkScenario, StationaryScanner, load_truth
from calgraph.simulation.network_beams import cast_walls
from calgraph.simulation.network_floor import Floor
from calgraph.simulation.network_layouts import build_layout
from calgraph.simulation.network_scanners import build_scanners

SEED = 0
"""Of simulated recordings."""
MIN_OVERLAP = 2.0
"""Scanners overlap that observe the same people for at least this long, s."""
_EVERY = 5
"""Every fifth sample of people's paths is examined."""


class Overlaps(NamedTuple):
    """Of all pairs of scanners."""

    names: tuple[str, ...]
    T_root_sensor: Array
    """(S, 3, 3) true poses in the plane."""
    pairs: NDArray[np.intp]
    """(P, 2) those that overlap, each once."""
    seconds: Array
    """(P,) how long both observe the same person, summed over people, s."""
    root: str
    """The scanner that overlaps most others, of those that overlaps connect with most others."""
    connectable: NDArray[np.bool_]
    """(S,) whether overlaps lead from the root to the scanner."""


def find_overlaps(place: Path) -> Overlaps:
    """The overlaps of a simulated recording, from its scenario.yaml and truth.yaml."""
    scenario = NetworkScenario.model_validate(read_yaml(place / "scenario.yaml"))
    truth = load_truth(place / "truth.yaml")
    floor, scanners = build_floor(scenario)
    seen = csr_array(np.column_stack(list(see_people(floor, scanners, truth))).astype(np.float64))
    together = (seen.T @ seen).tocoo()
    first, second = together.coords
    step = _EVERY * float(truth.people[0].times[1] - truth.people[0].times[0])
    enough = (first < second) & (together.data * step >= MIN_OVERLAP)
    pairs = np.column_stack([first[enough], second[enough]]).astype(np.intp)
    graph = csr_array((np.ones(len(pairs)), pairs.T), shape=(len(scanners), len(scanners)))
    _, component = connected_components(graph, directed=False)
    names = tuple(scanner.name for scanner in scanners)
    rows = np.ix_((0, 1, 3), (0, 1, 3))
    T = np.array([truth.T_root_sensor[name][rows] for name in names])
    connectable = component == np.bincount(component).argmax()
    partners = np.bincount(pairs.ravel(), minlength=len(names))
    root = names[int(np.argmax(np.where(connectable, partners, -1)))]
    return Overlaps(names, T, pairs, step * together.data[enough], root, connectable)


def build_floor(scenario: NetworkScenario) -> tuple[Floor, tuple[StationaryScanner, ...]]:
    """The floor and the scanners of a scenario, as in its recording, without the walks."""
    rng, error_rng = np.random.default_rng((SEED, 0)), np.random.default_rng((SEED, 0, 0, 1))
    layout = build_layout(scenario, rng)
    root = scenario.root or scenario.names[0]
    return layout.floor, build_scanners(scenario, layout.mounts, root, rng, error_rng)


def see_people(
    floor: Floor, scanners: tuple[StationaryScanner, ...], truth: GroundTruth
) -> Iterator[NDArray[np.bool_]]:
    """For each scanner, whether it observes each person at each time, (samples of all people)."""
    T_world_root = next(one.T_world_scanner for one in scanners if one.name == truth.root)
    paths = np.concatenate([person.positions[::_EVERY] for person in truth.people])
    places = se2.apply(T_world_root, paths)
    for scanner in scanners:
        plane = scanner.plane_at(scanner.T_world_scanner)
        distances = cast_walls(plane.origin, plane.angles, floor)
        off = places - plane.origin
        near = np.flatnonzero(np.abs(off).max(axis=1) < scanner.options.max_range)
        # Angles from the first beam, of beams that are in order and evenly spaced.
        angles = np.arctan2(off[near, 1], off[near, 0]) - plane.angles[0]
        beam = np.rint(np.remainder(angles, 2 * np.pi) / (plane.angles[1] - plane.angles[0])).astype(np.intp)
        distance = np.linalg.norm(off[near], axis=1)
        within = (beam < len(distances)) & (distance < scanner.options.max_range)
        clear = distances[np.minimum(beam, len(distances) - 1)] > distance
        seen = np.zeros(len(places), dtype=np.bool_)
        seen[near[within & clear]] = True
        yield seen


GROSS_DISTANCE, GROSS_ANGLE = 0.1, np.radians(2.0)
"""Beyond either one a scanner is grossly wrong relative to its neighbours, m and rad."""


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


def judge_poses(found: Calibration, truth: Overlaps) -> Quality:
    """Compares the poses of scanners that overlap, relative to each other, with the true ones.

    A scanner is grossly wrong if the median of its errors relative to its neighbours is beyond a limit.
    """
    rows = np.ix_((0, 1, 3), (0, 1, 3))
    T_root_scanner = np.array([sensor.T_root_sensor[rows] for sensor in found.sensors])
    good = np.array([sensor.verdict.grade == "good" for sensor in found.sensors])
    place = {sensor.name: k for k, sensor in enumerate(found.sensors)}
    both = np.array([truth.names[i] in place and truth.names[j] in place for i, j in truth.pairs], dtype=np.bool_)
    i, j = truth.pairs[both].T
    at = np.array([place.get(name, 0) for name in truth.names])
    T_estimated, T_true = (
        se2.inverse(T[a]) @ T[b] for T, a, b in ((T_root_scanner, at[i], at[j]), (truth.T_root_sensor, i, j))
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
        connected=len(place),
        connectable=int(truth.connectable.sum()),
        gross=len(wrong),
        confident=int(sum(good[at[k]] for k in wrong)),
        errors=distance,
    )
