"""Scans whose messages do not state the time of each beam: tracks of others show whether the scanner turns."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

from calgraph.io.records import decode_records, encode_records
from calgraph.network.options import NetworkOptions
from calgraph.network.track_recording import track_people, track_with_beam_times
from calgraph.network.tracking.scan_stack import ScanRun, add_beam_times, find_untimed_scans, stack_scans
from calgraph.network.tracking.track import TRACK_TYPES, ScannerTracks
from calgraph.recording import MessageRecording
from calgraph.sensors import LaserScan
from calgraph.sensors.untimed_scans import UntimedScans
from calgraph.simulation import NetworkScenario
from calgraph.simulation.network_scanners import StationaryScanner
from calgraph.simulation.network_simulation import build_network, network_rig, network_topic, simulate_scans

ANGLES = np.linspace(-2, 2, 5)


def make_run(increment: float = 0.0, angles: np.ndarray = ANGLES) -> ScanRun:
    ranges = np.arange(1.0, 21.0).reshape(4, 5)
    (run,) = stack_scans(LaserScan(k / 10, "laser", angles, row, increment) for k, row in enumerate(ranges))
    return run


def test_scans_without_times_are_those_whose_increments_are_all_zero() -> None:
    found = find_untimed_scans([make_run()])
    assert found is not None
    assert (found.first_angle, found.step, found.period) == pytest.approx((-2.0, 1.0, 0.1))
    assert find_untimed_scans([make_run(), make_run(1e-4)]) is None
    assert find_untimed_scans([]) is None


def test_times_of_a_turn_begin_at_the_first_beam_and_go_with_the_beams() -> None:
    np.testing.assert_allclose(
        UntimedScans(-np.pi / 2, 0.01, 0.2).turn_times(np.array([-np.pi / 2, 0, np.pi / 2, np.pi, -3])),
        [0, 0.05, 0.1, 0.15, 0.1 * (2.5 - 3 / np.pi)],
    )
    np.testing.assert_allclose(
        UntimedScans(np.pi / 2, -0.01, 0.2).turn_times(np.array([np.pi / 2, 0, -np.pi / 2])), [0, 0.05, 0.1]
    )


@pytest.mark.parametrize("angles", [ANGLES, ANGLES[::-1]])
def test_beams_get_the_times_of_a_turn(angles: np.ndarray) -> None:
    run = make_run(angles=angles)
    scans = find_untimed_scans([run])
    assert scans is not None
    (timed,) = add_beam_times([run], scans, 1)
    np.testing.assert_allclose(timed.increments, 0.1 / (2 * np.pi))
    np.testing.assert_array_equal(timed.angles, angles)
    (back,) = add_beam_times([run], scans, -1)
    np.testing.assert_allclose(back.increments, 0.1 / (2 * np.pi))
    np.testing.assert_array_equal(back.angles, angles[::-1])
    np.testing.assert_array_equal(back.read(np.arange(4)), run.read(np.arange(4))[:, ::-1])
    (same,) = add_beam_times([run], scans, 0)
    np.testing.assert_array_equal(same.increments, run.increments)


def test_scans_without_times_are_kept_with_the_tracks() -> None:
    untimed = UntimedScans(-2.0, 0.01, 0.1)
    tracks = ScannerTracks((), np.zeros((0, 2)), 0.01, untimed=untimed)
    again = decode_records(*encode_records(tracks), TRACK_TYPES)
    assert again.untimed == untimed


def make_recording(seed: int, turn: int, **scenario: object) -> tuple[object, MessageRecording]:
    """A network of scanners that turn (-1: against the order of their beams), or whose beams are simultaneous."""
    network = build_network(NetworkScenario.model_validate(scenario), seed)
    with mock.patch.object(StationaryScanner, "time_increment", 0.0) if turn == 0 else mock.patch.dict({}):
        scans = {s.name: list(simulate_scans(network, s)) for s in network.scanners}
    order = slice(None, None, turn or 1)
    messages = {
        network_topic(name): [
            replace(one, time_increment=0.0, angles=one.angles[order], ranges=one.ranges[order])
            for one in of_scanner
        ]
        for name, of_scanner in scans.items()
    }
    return network_rig(network), MessageRecording(messages)


@pytest.mark.slow
@pytest.mark.parametrize("turn", [1, 0, -1])
def test_tracks_show_whether_scanners_turn(turn: int) -> None:
    """A minute with two people in an office; in 13 such recordings of offices and labs all decisions are right."""
    rig, recording = make_recording(0, turn)
    with mock.patch("calgraph.network.track_recording.track_people", wraps=track_people) as tracking:
        _, _, findings = track_with_beam_times(rig, recording, NetworkOptions())  # type: ignore[arg-type]
    turns = [call.args[5] for call in tracking.call_args_list[1:]]
    assert turns == ([dict.fromkeys(rig.sensors, turn)] if turn else [])  # type: ignore[attr-defined]
    assert [finding.sensors for finding in findings] == ([()] if turn else [])
    if turn:
        assert "people are where scanners that turn in 67 ms measure them" in findings[0].text


@pytest.mark.slow
def test_tracks_that_do_not_show_it_make_poses_weak() -> None:
    """Legs that swing hide times within a scan."""
    rig, recording = make_recording(0, 1, duration=20.0, people={"shape": "legs"})
    _, _, findings = track_with_beam_times(rig, recording, NetworkOptions())  # type: ignore[arg-type]
    (finding,) = findings
    assert finding.sensors
    assert "the tracks do not show whether all are simultaneous" in finding.text
