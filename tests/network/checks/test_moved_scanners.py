"""Detection of moved scanners: which, how far, and the rate of false alarms."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.config.settings import DiagnosticsSettings, VerdictSettings
from calgraph.geometry import Array, se2
from calgraph.network.checks.moved_scanners import _MAX_SETS, MovedScanner, find_moved_scanners
from calgraph.network.joint.planar_poses import NetworkPoses
from calgraph.verdict.displaced_nodes import find_displaced_nodes

CHANCE = 1e-3
SETTINGS = DiagnosticsSettings()
MAX_SETS = _MAX_SETS
NAMES = ("a", "b", "c", "d", "e", "f")


def random_network(rng: np.random.Generator, count: int = 6) -> NetworkPoses:
    """Poses some metres apart, with correlated errors of millimetres."""
    T = se2.pose(rng.uniform(-3, 3, count), rng.uniform(-6, 6, (count, 2)))
    T[0] = np.eye(3)
    mixed = rng.normal(0, 1, (3 * count, 3 * count)) * np.tile([2e-3, 2e-3, 3e-4], count)[:, None] / 4
    spread = mixed @ mixed.T + np.diag(np.tile([1e-3, 1e-3, 1e-4], count) ** 2)
    spread[:3] = spread[:, :3] = 0
    return NetworkPoses(NAMES[:count], T, spread)


def measure_again(
    poses: NetworkPoses, rng: np.random.Generator, moved: dict[int, Array] | None = None
) -> NetworkPoses:
    """The poses estimated from another recording, some of them moved by a step in the root's axes."""
    T = poses.T_root_scanner.copy()
    for node, step in (moved or {}).items():
        T[node] = se2.retract(T[node], step)
    T = se2.inverse(T[0]) @ T
    spread = 2 * poses.covariance
    error = rng.multivariate_normal(np.zeros(len(spread)), spread).reshape(-1, 3)
    # The error of both recordings is added to one of them.
    return NetworkPoses(poses.names, se2.retract(T, error), poses.covariance)


def test_the_false_alarm_probability_is_as_stated() -> None:
    """600 networks at 5 %: 30 false alarms, with three standard deviations of 16."""
    verdict = VerdictSettings(false_alarm_probability=0.05)
    frequent = DiagnosticsSettings(verdict=verdict)
    alarms = 0
    for seed in range(600):
        rng = np.random.default_rng(seed)
        before = random_network(rng)
        alarms += bool(find_moved_scanners(before, measure_again(before, rng), frequent)[1])
    assert abs(alarms - 30) < 17


@pytest.mark.parametrize("node", range(6))
@pytest.mark.parametrize("step", [(0.03, 0, 0), (0, 0, np.radians(0.5))])
def test_only_the_moved_scanner_is_named(node: int, step: tuple[float, float, float]) -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        before = random_network(rng)
        reference, moved = find_moved_scanners(
            before, measure_again(before, rng, {node: np.array(step)}), SETTINGS
        )
        assert [one.name for one in moved] == [NAMES[node]], seed
        assert reference == ("b" if node == 0 else "a")


def test_distance_and_rotation_equal_the_displacement() -> None:
    rng = np.random.default_rng(4)
    before = random_network(rng)
    _, (moved,) = find_moved_scanners(
        before, measure_again(before, rng, {2: np.array([0.3, -0.4, 0.1])}), SETTINGS
    )
    assert moved.distance == pytest.approx(0.5, abs=0.02)
    assert moved.rotation == pytest.approx(0.1, abs=0.003)


def test_two_moved_scanners_are_named_even_if_one_is_the_root() -> None:
    steps = {0: np.array([0.05, 0, 0.02]), 3: np.array([0, 0.05, 0])}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        before = random_network(rng)
        assert [
            one.name for one in find_moved_scanners(before, measure_again(before, rng, steps), SETTINGS)[1]
        ] == ["a", "d"]


def test_of_two_scanners_the_root_is_assumed_to_have_stayed() -> None:
    rng = np.random.default_rng(0)
    before = random_network(rng, 2)
    after = measure_again(before, rng, {0: np.array([0.1, 0, 0])})
    reference, moved = find_moved_scanners(before, after, SETTINGS)
    assert (reference, [one.name for one in moved]) == ("a", ["b"])


def test_a_network_of_one_scanner_has_not_moved() -> None:
    assert find_displaced_nodes(np.eye(3)[None], np.zeros((1, 3)), np.zeros((3, 3)), CHANCE, MAX_SETS) == [()]


def test_three_of_thirty_are_found_by_the_incremental_search() -> None:
    rng = np.random.default_rng(1)
    count = 30
    T = se2.pose(rng.uniform(-3, 3, count), rng.uniform(-20, 20, (count, 2)))
    difference = rng.normal(0, (1e-3, 1e-3, 1e-4), (count, 3))
    difference[[4, 9, 20]] += [0.03, 0.02, 0.0]
    spread = np.diag(np.tile([1e-6, 1e-6, 1e-8], count))
    assert find_displaced_nodes(T, difference, spread, CHANCE, MAX_SETS) == [(4, 9, 20)]


def test_a_second_node_is_named_by_the_degrees_of_freedom_that_remain() -> None:
    # The squared distance of node 2 is 25: beyond the 0.999 quantile for six degrees of freedom, 22.5, but not for
    # the nine without a displaced node, 27.9.
    T = se2.pose(np.array([0.0, 1.0, 2.0, 3.0]), np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0], [4.0, 4.0]]))
    difference = np.zeros((4, 3))
    difference[1, 0], difference[2, 1] = 20.0, 5.0
    assert find_displaced_nodes(T, difference, np.eye(12), CHANCE, MAX_SETS) == [(1, 2)]


def test_poses_that_agree_exactly_have_not_moved() -> None:
    """Without covariances, the rounding of the poses remains."""
    exact = replace(random_network(np.random.default_rng(0)), covariance=np.zeros((18, 18)))
    assert find_moved_scanners(exact, exact, SETTINGS) == ("a", ())


@pytest.mark.parametrize(("degrees", "words"), [
    (-0.004, "12.3 mm and +0.00°"), (-0.006, "12.3 mm and -0.01°"), (1.5, "12.3 mm and +1.50°"),
])  # fmt: skip
def test_displacements_are_in_tenths_of_a_millimetre_and_hundredths_of_a_degree(
    degrees: float, words: str
) -> None:
    """Without the sign of what is rounded to zero."""
    assert str(MovedScanner("east", 0.01234, float(np.radians(degrees)))) == words
