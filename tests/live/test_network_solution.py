"""The calibration of a network from its recording until now."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Rig, load_rig
from calgraph.live.network_solution import LiveNetworkSolution, solve_recording
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network
from calgraph.recording import RecordingWriter, open_recording
from calgraph.result import Calibration
from calgraph.sensors import LaserScan
from calgraph.simulation import (
    HallScenario,
    NetworkErrors,
    NetworkScenario,
    ScannerOptions,
    load_truth,
    simulate_network,
)
from calgraph.simulation.hall_simulation import record_hall, simulate_hall

SCENARIO = NetworkScenario(
    layout="office", duration=24.0, scanner=ScannerOptions(count=3, resolution=1.0, rate=10.0)
)
Recorded = tuple[Rig, Path, Calibration]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """A network, its recording, and what calgraph calibrate computes from it."""
    place = tmp_path_factory.mktemp("live network")
    simulate_network(SCENARIO, place / "network", seed=2)
    rig = load_rig(place / "network/rig.yaml")
    with open_recording(place / "network/recording") as recording:
        return rig, place / "network/recording", calibrate_network(rig, recording, NetworkOptions())


@pytest.fixture(scope="module")
def solution(recorded: Recorded) -> LiveNetworkSolution:
    """The live solution from the whole recording."""
    return solve(*recorded[:2])


def solve(rig: Rig, path: Path, last: LiveNetworkSolution | None = None) -> LiveNetworkSolution:
    found = solve_recording(rig, path, last)
    assert found is not None
    return found


def with_intervals(rig: Rig, monkeypatch: pytest.MonkeyPatch, interval: float, min_interval: float) -> Rig:
    """The rig with other lengths of intervals, and of the least that is tracked after them."""
    monkeypatch.setattr("calgraph.live.tracked_intervals.MIN_INTERVAL", min_interval)
    network = rig.settings.live.network.model_copy(update={"interval": interval})
    live = rig.settings.live.model_copy(update={"network": network})
    return rig.model_copy(update={"settings": rig.settings.model_copy(update={"live": live})})


def assert_same_poses(live: LiveNetworkSolution, calibration: Calibration) -> None:
    for scanner in live.sensors:
        assert scanner.T_root_sensor is not None
        np.testing.assert_array_equal(scanner.T_root_sensor, calibration[scanner.name].T_root_sensor)
        assert scanner.grade == calibration[scanner.name].verdict.grade


def test_poses_are_those_of_the_command(recorded: Recorded, solution: LiveNetworkSolution) -> None:
    assert_same_poses(solution, recorded[2])
    assert not solution.done
    assert solution.used == pytest.approx(24, abs=0.5)


def test_standard_deviations_are_along_the_axes_of_the_scanner(
    recorded: Recorded, solution: LiveNetworkSolution
) -> None:
    root, *others = solution.sensors
    assert root.stddev.tolist() == [0] * 6
    for scanner in others:
        sensor = recorded[2][scanner.name]
        R = sensor.T_root_sensor[:2, :2]
        expected = np.sqrt(np.diag(R.T @ sensor.covariance[:2, :2] @ R))
        np.testing.assert_allclose(scanner.stddev, [*expected, 0, 0, 0, np.sqrt(sensor.covariance[5, 5])])
        # 95 % within 10 mm.
        assert scanner.uncertainty == pytest.approx(1.96 * scanner.stddev[:2].max() / 0.01, rel=1e-3)
        assert scanner.progress == pytest.approx(min(1, 1 / scanner.uncertainty))


def test_poses_of_joined_intervals_agree_with_those_of_the_whole(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, path, calibration = recorded
    found = solve(with_intervals(rig, monkeypatch, 8, 4), path)
    assert len(found.progress.intervals) == 2
    for scanner in found.sensors[1:]:
        assert scanner.T_root_sensor is not None
        sensor = calibration[scanner.name]
        off = np.abs(scanner.T_root_sensor[:2, 3] - sensor.T_root_sensor[:2, 3])
        assert np.all(off < 3 * np.sqrt(np.diag(sensor.covariance)[:2]))


def test_intervals_are_not_tracked_again(recorded: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    rig, path, _ = recorded
    rig = with_intervals(rig, monkeypatch, 16, 2)
    first = solve(rig, path)
    again = solve(rig, path, first)
    assert again.progress.until == first.progress.until
    assert again.progress.intervals == first.progress.intervals != ()
    for one, other in zip(first.sensors, again.sensors, strict=True):
        assert one.T_root_sensor is not None
        np.testing.assert_array_equal(one.T_root_sensor, other.T_root_sensor)


def test_a_long_recording_is_tracked_in_several_calls(recorded: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    rig, path, _ = recorded
    rig = with_intervals(rig, monkeypatch, 6, 4)
    monkeypatch.setattr("calgraph.live.tracked_intervals._MAX_INTERVALS", 2)
    first = solve(rig, path)
    assert first.end - first.start == pytest.approx(12, abs=0.3)
    second = solve(rig, path, first)
    assert second.end - second.start == pytest.approx(24, abs=0.5)


def test_a_recording_without_messages_has_no_solution(recorded: Recorded, tmp_path: Path) -> None:
    (tmp_path / "recording").mkdir()
    assert solve_recording(recorded[0], tmp_path / "recording", None) is None


def test_scanners_without_messages_have_the_reason(recorded: Recorded, tmp_path: Path) -> None:
    rig, path, _ = recorded
    with open_recording(path) as recording, RecordingWriter(tmp_path / "two") as writer:
        for record in recording.records(list(rig.topics.values())[:2], end=recording.start + 12):
            writer.write(record.topic, record.decode(), record.arrival)
    found = solve(rig, tmp_path / "two")
    assert found.sensors[2].reason == "it has sent no messages yet"
    assert found.sensors[2].T_root_sensor is None


def test_a_lone_root_has_no_pose(recorded: Recorded, tmp_path: Path) -> None:
    rig, path, _ = recorded
    with open_recording(path) as recording, RecordingWriter(tmp_path / "short") as writer:
        for record in recording.records(end=recording.start + 1):
            writer.write(record.topic, record.decode(), record.arrival)
    found = solve(rig, tmp_path / "short")
    assert [one.T_root_sensor for one in found.sensors] == [None] * 3
    assert not replace(found, sensors=()).done
    assert found.grid is None


def test_the_time_between_two_runs_is_not_tracked(
    recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, path, _ = recorded
    with open_recording(path) as recording, RecordingWriter(tmp_path / "two runs") as writer:
        for record in recording.records(end=recording.start + 16):
            pause = 86_400.0 if record.arrival > recording.start + 8 else 0.0
            message = record.decode()
            assert isinstance(message, LaserScan)
            writer.write(record.topic, replace(message, stamp=message.stamp + pause), record.arrival + pause)
    found = solve(with_intervals(rig, monkeypatch, 6, 2), tmp_path / "two runs")
    assert found.recorded == pytest.approx(16, abs=0.5)
    assert found.end - found.start == pytest.approx(86_416, abs=0.5)
    assert [one.duration for one in found.progress.intervals] == pytest.approx([6, 2], abs=0.2)


def test_fewer_intervals_are_used_where_a_solution_takes_too_long(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, path, _ = recorded
    rig = with_intervals(rig, monkeypatch, 6, 4)
    monkeypatch.setattr("calgraph.live.network_solution._MAX_WORK", 0.001)
    found = solve(rig, path)
    assert found.used == pytest.approx(24, abs=0.5)
    assert len(found.progress.intervals) == 1
    assert found.progress.duration == pytest.approx(18, abs=0.5)


def test_a_scanner_moved_between_two_intervals_has_its_pose_after_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = NetworkErrors(bump_shift=0.2, bump_turn=3.0, bump_time=15.5 / 36)
    scanners = ScannerOptions(count=2, resolution=1.0, rate=10.0)
    scenario = NetworkScenario(layout="office", duration=36.0, scanner=scanners, errors=moved)
    simulate_network(scenario, tmp_path / "network", seed=3)
    rig = with_intervals(load_rig(tmp_path / "network/rig.yaml"), monkeypatch, 15, 5)
    monkeypatch.setattr("calgraph.live.tracked_intervals._OVERLAP", 12)
    found = solve(rig, tmp_path / "network/recording")
    assert len(found.progress.intervals) == 2
    (other,) = found.sensors[1:]
    truth = load_truth(tmp_path / "network/truth.yaml").T_root_sensor[other.name]
    assert other.T_root_sensor is not None
    assert np.linalg.norm((other.T_root_sensor - truth)[:2, 3]) < 0.02
    assert any("moved by" in remark for remark in (*found.remarks, other.reason))


@pytest.mark.slow
def test_lidars_of_a_hall_are_calibrated_and_drawn_on_a_level_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the last 15 s of 20; people walk on the floor between the LiDARs."""
    monkeypatch.setattr("calgraph.live.network_solution._MAX_DURATION", 15.0)
    record_hall(simulate_hall(HallScenario(5, duration=20.0, lidars=("vlp16",) * 2)), tmp_path, lambda *_: None)
    rig = load_rig(tmp_path / "rig.yaml")
    found = solve(rig, tmp_path / "recording")
    assert found.used == pytest.approx(15.0, abs=0.2)
    assert found.recorded == pytest.approx(20.0, abs=0.5)
    assert [one.tracks > 0 for one in found.sensors] == [True, True]
    truth = load_truth(tmp_path / "truth.yaml").T_root_sensor
    places = []
    for one in found.sensors:
        assert one.T_root_sensor is not None
        assert np.linalg.norm(one.T_root_sensor[:3, 3] - truth[one.name][:3, 3]) < 0.1
        places.append(one.express_in(found.T_plan_root).origin)
    # LiDARs hang 2 to 4 m above the floor, which is at height 0 of the plan.
    assert all(2.0 < place[2] < 4.0 for place in places)
    assert found.grid is not None
    assert found.grid.walked.any()
    low, high = found.grid.origin, found.grid.origin + found.grid.cell * np.array(found.grid.walked.shape)
    assert all(np.all((place[:2] > low) & (place[:2] < high)) for place in places)
