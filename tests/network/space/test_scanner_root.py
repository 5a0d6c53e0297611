"""Mixed networks whose root is a 2-D scanner: the same poses and clocks as against a LiDAR, relative to it."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network
from calgraph.recording.record_list import IndexedRecording
from calgraph.result import Calibration
from calgraph.simulation import HallScenario, SimulatedHall, simulate_hall

pytestmark = pytest.mark.slow
ROOT = "scanner_2"
"""It is upside-down."""
TILT = 0.5
"""Standard deviation of the stated tilts of scanners, degrees."""


@cache
def hall() -> SimulatedHall:
    """Two LiDARs and two scanners, which are level at their stated heights; clocks up to 50 ms apart."""
    return simulate_hall(HallScenario(0, duration=20.0, lidars=("xt32",) * 2, scanners=(0.3, 0.9)))


def rig_of(root: str, names: tuple[str, ...] = ("lidar_1", "lidar_2", "scanner_1", "scanner_2")) -> Rig:
    plain = hall().rig.to_plain()
    heights = {"scanner_1": 0.3, "scanner_2": 0.9}
    stated = {name: {"height": h, "uncertainty": {"tilt": TILT}} for name, h in heights.items()}
    sensors = {name: plain["sensors"][name] | stated.get(name, {}) for name in names}
    return Rig.model_validate({"root": root, "target": {"kind": "people"}, "sensors": sensors})


def calibrate(root: str, options: NetworkOptions = NetworkOptions()) -> Calibration:
    return calibrate_network(rig_of(root), hall().recording, options)


@cache
def calibrated(root: str) -> Calibration:
    return calibrate(root)


def muted(name: str) -> IndexedRecording:
    """The recording with half a second of a sensor, in which it tracks no person."""
    recording = hall().recording
    topic = rig_of(ROOT).topics[name]
    kept = [one for one in recording.records() if one.topic != topic or one.stamp < recording.start + 0.5]
    types = {one.name: one.type for one in recording.topics}
    return IndexedRecording(Path("messages"), kept, types)


def test_poses_and_clocks_are_those_of_a_network_with_a_lidar_as_root() -> None:
    expected, found = calibrated("lidar_1"), calibrated(ROOT)
    names = [one.name for one in expected.sensors]
    assert (found.root, found.sensors[0].name, found.sensors[0].parent) == (ROOT, ROOT, None)
    assert found.evidence.unconnected == {}
    for a in names:
        for b in set(names) - {a}:
            np.testing.assert_allclose(found.transform(a, b), expected.transform(a, b), atol=1e-9)
            np.testing.assert_allclose(found.covariance(a, b), expected.covariance(a, b), atol=1e-9)
    root = expected[ROOT]
    assert root.clock_offset is not None
    assert found[ROOT].clock_offset is None
    assert found["lidar_1"].clock_offset == pytest.approx(-root.clock_offset, abs=1e-12)
    assert found["lidar_1"].clock_offset_stddev == pytest.approx(root.clock_offset_stddev)
    other, clock = found["lidar_2"], expected["lidar_2"].clock_offset
    assert clock is not None
    assert other.clock_offset == pytest.approx(clock - root.clock_offset, abs=1e-12)
    for name in names:
        offset, truth = found[name].clock_offset or 0.0, hall().truth.clock_offsets
        stddev = found[name].clock_offset_stddev or 0.001
        assert abs(offset - truth[name] + truth[ROOT]) < 4 * stddev
    level = found.pictures.T_plan_root @ found["lidar_1"].T_root_sensor
    np.testing.assert_allclose(level, expected.pictures.T_plan_root, atol=1e-9)


def test_grades_are_of_errors_relative_to_the_root_whose_tilt_is_stated() -> None:
    """Half a degree of tilt is 9 mm over each metre of distance, and no LiDAR is nearer than 4 m."""
    found = calibrated(ROOT)
    for name in ("lidar_1", "lidar_2"):
        one = found[name]
        distance = np.linalg.norm(one.T_root_sensor[:2, 3])
        height = np.sqrt(one.covariance[2, 2])
        assert height == pytest.approx(np.hypot(0.05, np.radians(np.hypot(TILT, 0.3)) * distance), rel=0.1)
        assert one.verdict.grade != "good"
        assert "stated height and tilt of the root" in one.verdict.reason
        assert f"the root {ROOT} measures do not show its height, roll and pitch" in one.verdict.reason


def test_a_network_is_extended_with_a_scanner_that_is_upside_down_as_its_root() -> None:
    """The same recording again, after lidar_1 was moved: standard deviations fall by no more than the new ones."""
    earlier = calibrated(ROOT)
    assert earlier["scanner_1"].T_root_sensor[2, 2] < 0  # upright
    found = calibrate(ROOT, NetworkOptions(extend=earlier, moved=("lidar_1",)))
    assert [one.name for one in found.sensors] == [ROOT, "lidar_2", "lidar_1", "scanner_1"]
    assert found.evidence.unconnected == {}
    for one in found.sensors[1:]:
        off = np.abs(one.T_root_sensor - earlier[one.name].T_root_sensor)
        assert off[:3, :3].max() < 0.005
        assert off[:3, 3].max() < 0.02
    assert found["scanner_1"].verdict.grade == earlier["scanner_1"].verdict.grade


@pytest.mark.parametrize(
    ("silent", "placed"), [("lidar_1", {"lidar_2", "scanner_1"}), (ROOT, set())], ids=["reference", "root"]
)
def test_sensors_that_are_not_connected_to_the_root_have_a_reason(silent: str, placed: set[str]) -> None:
    """Another LiDAR takes the place of the first; without the root, nothing has a pose."""
    found = calibrate_network(rig_of(ROOT), muted(silent), NetworkOptions())
    assert {one.name for one in found.sensors} == {ROOT, *placed}
    assert set(found.evidence.unconnected) == {"lidar_1", "lidar_2", "scanner_1"} - placed
    if silent == ROOT:
        assert found[ROOT].verdict.grade == "unobservable"
        assert found.evidence.unconnected["lidar_1"].startswith(
            "is connected to lidar_2, scanner_1, but the root scanner_2 is not: "
        )
