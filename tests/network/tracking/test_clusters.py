"""Objects in the foreground of scans."""

import numpy as np
import pytest

from calgraph.config.settings import ClusterSettings
from calgraph.geometry import Array
from calgraph.network.tracking.clusters import Clusters, cluster_foreground, subtract_background
from calgraph.network.tracking.scan_stack import stack_scans
from calgraph.network.tracking.static_scene import StaticScene
from calgraph.sensors import LaserScan, ScanBackground

ANGLES = np.radians(np.arange(-90, 90.25, 0.5))
EMPTY = StaticScene(ScanBackground(ANGLES, np.full(len(ANGLES), 8.0)), np.empty((0, 2)), 0.02)
WIDTH = 0.5
SETTINGS = ClusterSettings()


def scan(*objects: tuple[float, float, float], stamp: float = 0.0, increment: float = 1e-4) -> LaserScan:
    """A scan with objects (x, y, diameter), modelled as discs facing the scanner, before a wall at 10 m."""
    ranges = np.full(len(ANGLES), 10.0)
    for x, y, diameter in objects:
        off = ANGLES - np.arctan2(y, x)
        distance = np.hypot(x, y)
        ranges = np.where(np.abs(off) < np.arctan(diameter / 2 / distance), np.minimum(ranges, distance), ranges)
    return LaserScan(stamp, "laser", ANGLES, ranges, increment)


def found(*scans: LaserScan) -> Clusters:
    return cluster_foreground(subtract_background(stack_scans(scans), EMPTY), WIDTH, 0.02, SETTINGS)


def test_one_object_is_one_cluster() -> None:
    np.testing.assert_allclose(found(scan((4, 1, 0.4))).centroids, [[4, 1]], atol=0.05)


def test_two_legs_are_one_object() -> None:
    assert len(found(scan((3, 0.2, 0.12), (3.2, -0.2, 0.12)))) == 1


def test_two_people_side_by_side_are_two() -> None:
    assert len(found(scan((4, 0.45, 0.4), (4, -0.45, 0.4)))) == 2


def test_a_person_behind_another_is_a_second_cluster() -> None:
    assert len(found(scan((3, 0, 0.4), (5, 0.6, 0.5)))) == 2


def test_both_sides_of_an_occluder_are_one_object() -> None:
    result = found(scan((2, 0, 0.1), (5, 0, 0.5)))
    assert sorted(np.round(result.centroids[:, 0])) == [2, 5]


def test_a_partly_occluded_object_is_clipped() -> None:
    result = found(scan((3, 0, 0.4), (5, 0.45, 0.5)))
    assert result.clipped[np.argsort(result.centroids[:, 0])].tolist() == [False, True]


def test_an_object_at_the_end_of_the_field_of_view_is_clipped() -> None:
    assert found(scan((0.05, 4, 0.4))).clipped.tolist() == [True]


def test_much_wider_clusters_are_dropped() -> None:
    assert len(found(scan((4, 0, 1.5)))) == 0


def test_a_single_beam_is_no_object() -> None:
    assert len(found(scan((4, 0, 0.03)))) == 0


@pytest.mark.parametrize("increment", [1e-4, -1e-4])
def test_times_are_those_of_the_objects_beams(increment: float) -> None:
    result = found(scan((4, 4, 0.4), stamp=100.0, increment=increment))
    beam = np.radians(135) / np.radians(0.5)
    assert result.times[0] == pytest.approx(100 + beam * increment, abs=abs(increment))


def test_a_clockwise_scanner_gives_the_same_clusters() -> None:
    plain = scan((4, 1, 0.4), (3, -2, 0.4))
    turned = LaserScan(0.0, "laser", plain.angles[::-1], plain.ranges[::-1], 1e-4)
    np.testing.assert_allclose(found(turned).centroids[::-1], found(plain).centroids)


def test_repeated_and_late_scans_count_once() -> None:
    person = (4.0, 0.0, 0.4)
    result = found(
        scan(person, stamp=1.0), scan(person, stamp=1.0), scan(person, stamp=0.5), scan(person, stamp=2.0)
    )
    assert result.scan.tolist() == [0, 1]


def test_beams_without_measurement_do_not_split() -> None:
    person = scan((4, 0, 0.45))
    middle = len(ANGLES) // 2
    ranges: Array = person.ranges.copy()
    ranges[[middle, middle + 1]] = np.nan
    assert len(found(LaserScan(0.0, "laser", ANGLES, ranges))) == 1


def test_background_alone_gives_no_object() -> None:
    assert len(found(scan())) == 0


def test_no_scans_give_no_objects() -> None:
    assert len(found()) == 0
