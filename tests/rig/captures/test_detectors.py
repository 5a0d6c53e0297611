"""The detectors of a rig, and the backgrounds that its scanners learn."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners, PlanePatch
from calgraph.config import Board, Capture, Lidar2dSpec, Lidar3dSpec, Rig
from calgraph.config.settings import CaptureBackgroundSettings, CaptureSettings, DetectionSettings, Settings
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.recording import MessageRecording
from calgraph.rig.captures.detectors import learn_backgrounds, learn_backgrounds_of_captures, make_detectors
from calgraph.rig.captures.holds import Hold
from calgraph.rig.detection.capture_background import CloudBackground
from calgraph.sensors import LaserScan, Message, PointCloud, RecordedMessage, ScanBackground
from calgraph.sensors.cloud_to_scan import to_scans

ANGLES = np.radians(np.arange(-60, 60, 0.5))
RIG = Rig(
    root="lidar",
    target=Board(size=(1.0, 0.8)),
    sensors={
        "lidar": Lidar3dSpec(kind="lidar3d", topic="/points"),
        "laser": Lidar2dSpec(kind="lidar2d", topic="/scan"),
        "flat": Lidar2dSpec(kind="lidar2d", topic="/flat"),
    },
    capture=Capture(background=(0.0, 5.0)),
)


def ranges_to_boards(azimuth: Array, *bearings: float) -> Array:
    """Ranges to boards 2 m away, 1 m wide, in front of a wall at 5 m."""
    ranges: Array = 5 / np.cos(azimuth)
    for bearing in bearings:
        off = azimuth - bearing
        ranges = np.where(np.abs(2 * np.tan(off)) < 0.5, 2 / np.cos(off), ranges)
    return ranges


def scan(*bearings: float, stamp: float = 0.0) -> LaserScan:
    return LaserScan(stamp, "laser", ANGLES, ranges_to_boards(ANGLES, *bearings))


def cloud(*bearings: float, stamp: float = 0.0) -> PointCloud:
    """Boards 0.8 m high, and the wall."""
    azimuth, elevation = (a.ravel() for a in np.meshgrid(ANGLES, np.radians(np.arange(-20, 20, 1.0))))
    horizontal = ranges_to_boards(azimuth, *bearings)
    on_board = (horizontal < 4) & (np.abs(horizontal * np.tan(elevation)) < 0.4)
    horizontal = np.where(on_board, horizontal, 5 / np.cos(azimuth))
    points = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)]) * horizontal[:, None]
    return PointCloud(stamp, "lidar", points)


def records(topic: str, messages: Sequence[Message], decoded: list[str]) -> list[RecordedMessage]:
    def decode(message: Message) -> Message:
        decoded.append(topic)
        return message

    return [RecordedMessage(topic, 0.1 * i, 0.1 * i, partial(decode, m)) for i, m in enumerate(messages)]


@pytest.mark.parametrize("known", [False, True])
def test_boards_of_the_background_are_no_candidates(known: bool) -> None:
    """A second board, which stands there all the time, is one unless the background is known."""
    decoded: list[str] = []
    window = records("/points", [cloud(-0.6)] * 3, decoded) + records("/scan", [scan(-0.6)] * 3, decoded)
    learned = learn_backgrounds(window, RIG) if known else {}
    backgrounds = {name: one for name, one in learned.items() if not isinstance(one, Rejected)}
    detectors = make_detectors(RIG, {}, backgrounds, None, dict.fromkeys(RIG.sensors, 0))
    patches = detectors["lidar"]([cloud(-0.6, 0.5)])
    segments = detectors["laser"]([scan(-0.6, 0.5)])
    assert not isinstance(patches, Rejected)
    assert not isinstance(segments, Rejected)
    for found in (patches, segments):
        boards = [d.center for d in found if not isinstance(d, BoardCorners) and d.match > 0.5]
        bearings = sorted(round(float(np.arctan2(y, x)), 1) for x, y, _ in boards)
        assert bearings == ([0.5] if known else [-0.6, 0.5])


def test_each_scanner_learns_from_its_own_messages() -> None:
    decoded: list[str] = []
    window = records("/points", [cloud()], decoded) + records("/scan", [scan()], decoded)
    backgrounds = learn_backgrounds(window, RIG)
    assert isinstance(backgrounds["lidar"], CloudBackground)
    assert isinstance(backgrounds["laser"], ScanBackground)
    assert list(backgrounds) == ["lidar", "laser", "flat"]
    assert isinstance(backgrounds["flat"], Rejected)
    assert backgrounds["flat"].reason.startswith("no returns in the background window; state a capture.background")


def test_no_more_messages_are_decoded_than_a_background_needs() -> None:
    decoded: list[str] = []
    learn_backgrounds(records("/scan", [scan()] * 70, decoded), RIG)
    assert len(decoded) == 60
    rig = RIG.model_copy(update={"settings": Settings(captures=CaptureSettings(max_background_messages=4))})
    learn_backgrounds(records("/scan", [scan()] * 70, decoded), rig)
    assert len(decoded) == 64


def test_without_a_window_there_is_no_background() -> None:
    rig = RIG.model_copy(update={"capture": Capture()})
    assert learn_backgrounds(records("/scan", [scan()], []), rig) == {}


def test_samples_depend_on_seed_and_stamp_only() -> None:
    """In whatever order captures are searched, detections are the same."""
    clouds = [cloud(0.5, stamp=t) for t in (1.0, 2.0)]
    planes = []
    for order in (clouds, clouds[::-1]):
        detect = make_detectors(RIG, {}, {}, None, dict.fromkeys(RIG.sensors, 7))["lidar"]
        found = {c.stamp: detect([c]) for c in order}
        planes.append([found[t][0].plane for t in (1.0, 2.0)])  # type: ignore[index,union-attr]
    np.testing.assert_array_equal(planes[0], planes[1])


def test_clouds_of_2d_scanners_become_scans() -> None:
    points = scan().points
    converted = to_scans([PointCloud(3.0, "flat", points), scan(stamp=4.0)])
    assert [s.stamp for s in converted] == [3.0, 4.0]
    np.testing.assert_allclose(converted[0].ranges[np.isfinite(converted[0].ranges)], scan().ranges)


def hold_each(clouds: Sequence[PointCloud], *, auxiliary: bool = False) -> list[Hold]:
    """A hold for each cloud, in which the other sensors measured nothing."""
    none = np.zeros(0)
    return [
        Hold(i, c.stamp, c.stamp, {"lidar": np.array([c.stamp]), "laser": none, "flat": none}, auxiliary=auxiliary)
        for i, c in enumerate(clouds)
    ]


def find_boards(clouds: Sequence[PointCloud], rig: Rig = RIG) -> list[float]:
    """Bearings of candidates that match a board in the first cloud, with what is learned from all of them."""
    recording = MessageRecording({"/points": clouds})
    learned = learn_backgrounds_of_captures(rig, recording, hold_each(clouds), without=())
    found = make_detectors(rig, {}, learned, None, dict.fromkeys(rig.sensors, 0))["lidar"](clouds[:1])
    assert not isinstance(found, Rejected)
    boards = [one.center for one in found if isinstance(one, PlanePatch) and one.match > 0.5]
    return sorted(round(float(np.arctan2(y, x)), 1) for x, y, _ in boards)


BESIDE_FURNITURE = [cloud(-0.6, b, stamp=float(i)) for i, b in enumerate([0.5, 0.1, 0.3, 0.8] * 2)]
"""A board in several places, and a second one that stands at -0.6 in all captures."""


def test_captures_show_which_board_is_furniture() -> None:
    assert find_boards(BESIDE_FURNITURE) == [0.5]


def test_empty_clouds_do_not_hide_what_is_static() -> None:
    lost = [PointCloud(8.0 + i, "lidar", np.empty((0, 3))) for i in range(3)]
    assert find_boards([*BESIDE_FURNITURE, *lost]) == [0.5]


def test_a_board_that_never_moves_is_still_found() -> None:
    assert find_boards([cloud(0.3, stamp=float(i)) for i in range(8)]) == [0.3]


def test_the_background_of_captures_can_be_turned_off() -> None:
    settings = DetectionSettings(capture_background=CaptureBackgroundSettings(min_captures=1000))
    rig = RIG.model_copy(update={"settings": Settings(detection=settings)})
    assert find_boards(BESIDE_FURNITURE, rig) == [-0.6, 0.5]


def test_only_lidars_without_background_learn_it_from_captures() -> None:
    clouds = [cloud(stamp=float(i)) for i in range(8)]
    recording, holds = MessageRecording({"/points": clouds}), hold_each(clouds)
    assert list(learn_backgrounds_of_captures(RIG, recording, holds, without=())) == ["lidar"]
    assert learn_backgrounds_of_captures(RIG, recording, holds, without=["lidar"]) == {}
    auxiliary = hold_each(clouds, auxiliary=True)
    assert learn_backgrounds_of_captures(RIG, recording, holds[:4] + auxiliary[4:], without=()) == {}


def test_each_beam_of_a_candidate_has_its_own_time() -> None:
    whole = cloud(-0.6, 0.5)
    timed = replace(whole, times=np.linspace(0.0, 0.1, len(whole.points)))
    found = make_detectors(RIG, {}, {}, None, dict.fromkeys(RIG.sensors, 7))["lidar"]([timed])
    assert not isinstance(found, Rejected)
    assert len(found) >= 2
    for patch in found:
        assert isinstance(patch, PlanePatch)
        measured = np.rint(patch.times / 0.1 * (len(whole.points) - 1)).astype(int)
        np.testing.assert_allclose(whole.points[measured], patch.points, atol=1e-9)
