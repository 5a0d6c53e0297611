"""The time before anything enters a scanner's view: found, and not taken for a board that rests."""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from calgraph.config import Board, Capture, Rig, Tag
from calgraph.config.settings import CameraDetectionSettings, CaptureSettings
from calgraph.geometry import Array
from calgraph.recording import Recording, open_recording
from calgraph.recording.record_list import MessageRecording
from calgraph.rig.captures.empty_start import EmptyStart, find_empty_start, resolve_background
from calgraph.sensors import Image, LaserScan, PointCloud, Trigger

ANGLES = np.radians(np.arange(-90.0, 90.0, 0.5))
WALL, PERSON = 4.0, 2.0
IN_VIEW, ELSEWHERE = (np.abs(ANGLES - angle) < np.radians(4) for angle in (0.3, -0.4))


def view(*bodies: Array) -> Array:
    """Ranges to bodies in front of a wall."""
    return np.where(np.any(bodies, axis=0), PERSON, WALL) if bodies else np.full(len(ANGLES), WALL)


def record(view_at: Callable[[float], Array], rate: float = 10.0) -> MessageRecording:
    """Scans whose ranges are a function of time, with noise of 2 cm."""
    rng = np.random.default_rng(3)
    return MessageRecording(
        {
            "/scan": [
                LaserScan(float(t), "", ANGLES, view_at(float(t)) + 0.02 * rng.standard_normal(len(ANGLES)))
                for t in np.arange(0.0, 20.0, 1 / rate)
            ]
        }
    )


def find(recording: MessageRecording) -> EmptyStart | None:
    return search(recording)


def search(
    recording: Recording,
    scanners: Sequence[str] = ("/scan",),
    cameras: Sequence[str] = (),
    boards: Sequence[Board] = (),
    capture: Capture | None = None,
    settings: CaptureSettings = CaptureSettings(),
) -> EmptyStart | None:
    return find_empty_start(
        recording, scanners, cameras, boards, capture or Capture(), settings, CameraDetectionSettings()
    )


def test_it_ends_before_a_person_enters() -> None:
    found = find(record(lambda t: view(IN_VIEW) if t > 4.95 else view()))
    assert found is not None
    assert found.topic == "/scan"
    assert [found.entry, found.end] == pytest.approx([5.0, 4.7])


def test_a_board_that_rests_in_view_at_the_start_is_not_empty() -> None:
    assert find(record(lambda t: view(ELSEWHERE) if t > 4.95 else view(IN_VIEW))) is None


def test_a_start_that_is_too_short_is_none() -> None:
    assert find(record(lambda t: view(IN_VIEW) if t > 1.55 else view())) is None


def test_a_recording_without_anybody_has_none() -> None:
    assert find(record(lambda _: view())) is None


def test_a_single_scan_with_something_else_is_no_entry() -> None:
    assert find(record(lambda t: view(IN_VIEW) if 4.95 < t < 5.05 else view())) is None


def test_a_scanner_slower_than_the_reference_is_searched() -> None:
    found = find(record(lambda t: view(IN_VIEW) if t > 7.0 else view(), rate=1 / 1.5))
    assert found is not None
    assert found.entry == pytest.approx(7.5)


@pytest.mark.parametrize(("messages", "is_found"), [(1, False), (2, False), (3, True)])
def test_three_messages_show_what_is_empty(messages: int, is_found: bool) -> None:
    """Pose 1 of snapshots was taken for the empty room, as the board of pose 2 is elsewhere."""
    found = find(record(lambda t: view(IN_VIEW) if t > 1.5 * messages - 0.75 else view(), rate=1 / 1.5))
    assert (found is not None) == is_found


def test_nobody_enters_while_a_scanner_pauses() -> None:
    """A recorder that is stopped between poses, and a board that hides nothing behind it."""

    def record_with_pause(pause: float) -> MessageRecording:
        stamps = [t for t in np.arange(0.0, 20.0, 0.1) if not 3.0 < t < 3.0 + pause]
        rng = np.random.default_rng(1)
        ranges = [view(IN_VIEW) if t > 3.1 else view() for t in stamps]
        scans = [
            LaserScan(float(t), "", ANGLES, one + 0.02 * rng.standard_normal(len(one)))
            for t, one in zip(stamps, ranges, strict=True)
        ]
        return MessageRecording({"/scan": scans})

    assert find(record_with_pause(0.15)) is not None
    assert find(record_with_pause(2.0)) is None


def numbered(folder: Path) -> Path:
    """Five snapshots of a board in front of nothing, numbered as users do."""
    for number in range(1, 6):
        body = np.abs(ANGLES - 0.2 * number + 0.5) < np.radians(4)
        scan = np.where(body, PERSON, np.nan)
        path = folder / f"laser/pose{number}.npz"
        path.parent.mkdir(exist_ok=True)
        np.savez(path, angle_min=ANGLES[0], angle_increment=ANGLES[1] - ANGLES[0], ranges=scan)
    return folder


def test_snapshots_have_none(tmp_path: Path) -> None:
    settings = CaptureSettings(max_snapshot_gap=0.01)
    by_stamp = record(lambda t: view(IN_VIEW) if t > 4.95 else view())
    assert search(by_stamp, settings=settings) is None  # each message is a snapshot
    assert search(by_stamp, capture=Capture(mode="snapshots")) is None
    with open_recording(numbered(tmp_path)) as recording:
        assert search(recording, ["laser"]) is None


def images(shows_board: Callable[[float], bool], rate: float = 5.0) -> list[Image]:
    """A camera before which a tag is held now and then."""
    tag = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), 3, 100)
    empty = np.full((240, 320), 200, np.uint8)
    with_tag = empty.copy()
    with_tag[60:160, 100:200] = tag
    return [Image(float(t), "", with_tag if shows_board(t) else empty) for t in np.arange(0.0, 20.0, 1 / rate)]


@pytest.mark.parametrize(
    ("shows_board", "end"),
    [
        (lambda _: False, 4.7),
        (lambda t: t > 4.9, 4.7),
        (lambda t: t > 3.5, 3.2),  # the last image that was searched before
        (lambda _: True, None),
        (lambda t: t < 1.0, None),
        (lambda t: t > 1.4, None),
    ],
    ids=["never", "after the scanner", "before the scanner", "always", "at the start", "soon"],
)
def test_it_ends_before_a_camera_detects_the_board(
    shows_board: Callable[[float], bool], end: float | None
) -> None:
    scans = record(lambda t: view(IN_VIEW) if t > 4.95 else view())
    messages = [one.decode() for one in scans.records()]
    recording = MessageRecording({"/scan": messages, "/camera": images(shows_board)})
    board = Board(kind="board", size=(0.6, 0.6), tags=(Tag(id=3, size=0.3, center=(0.0, 0.0)),))
    found = search(recording, cameras=["/camera"], boards=[board])
    assert (found.end if found else None) == pytest.approx(end) if end else found is None
    other = Board(kind="board", size=(0.6, 0.6), tags=(Tag(id=4, size=0.3, center=(0.0, 0.0)),))
    assert search(recording, cameras=["/camera"], boards=[other]) is not None


@pytest.mark.parametrize(("trigger", "end"), [(9.0, 4.7), (3.0, 3.0), (1.0, None)])
def test_it_ends_before_the_first_trigger(trigger: float, end: float | None) -> None:
    scans = record(lambda t: view(IN_VIEW) if t > 4.95 else view())
    messages = [one.decode() for one in scans.records()]
    recording = MessageRecording({"/scan": messages, "/trigger": [Trigger(trigger), Trigger(12.0)]})
    found = search(recording, capture=Capture(trigger="/trigger"))
    assert (found.end if found else None) == end


def test_a_calibration_states_the_window_that_was_found() -> None:
    rig = Rig.model_validate(
        {
            "root": "laser",
            "target": {"kind": "board", "size": [0.6, 0.6]},
            "sensors": {name: {"kind": "lidar2d", "topic": f"/{name}"} for name in ("laser", "other")},
        }
    )
    scans = [one.decode() for one in record(lambda t: view(IN_VIEW) if t > 4.95 else view()).records()]
    recording = MessageRecording({"/laser": scans, "/other": scans[:100]})
    resolved, (finding,) = resolve_background(rig, recording)
    assert resolved.capture.background == pytest.approx((0.0, 4.7))
    assert finding.text.startswith("rig.yaml states no capture.background: 0.0 to 4.7 s from the start were found")
    assert "what laser, other detect depends on it" in finding.text
    stated, findings = resolve_background(resolved, recording)
    assert (stated, findings) == (resolved, ())


def test_clouds_are_searched_as_scans_are() -> None:
    azimuth, elevation = (grid.ravel() for grid in np.meshgrid(ANGLES, np.radians(np.arange(-10.0, 11.0, 2.0))))
    rays = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    person = (np.abs(azimuth - 0.3) < 0.07) & (np.abs(elevation) < 0.1)
    clouds = [
        PointCloud(float(t), "", rays * np.where(person & (t > 4.95), PERSON, WALL)[:, None])
        for t in np.arange(0.0, 20.0, 0.1)
    ]
    found = search(MessageRecording({"/points": clouds}), ["/points"])
    assert found is not None
    assert found.entry == pytest.approx(5.0)
