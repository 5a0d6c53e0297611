"""Which scanners of a simulated network observe the same people simultaneously, from its ground truth.

A person in range and field of view is observed where no wall or furniture hides the middle of the body.
That other people may hide it is left out.
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
