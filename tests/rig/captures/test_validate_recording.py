"""Checks of a recording against its rig."""

import numpy as np
import pytest

from calgraph.config import Board, Capture, Lidar2dSpec, Lidar3dSpec, Rig, SensorSpec
from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.recording import TopicInfo
from calgraph.recording.recording import TimeBase
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes
from calgraph.rig.captures.validate_recording import check_pose_numbers, check_timeline

STAMPS = np.arange(100.0, 160.0, 0.5)


def rig(**capture: object) -> Rig:
    sensors: dict[str, SensorSpec] = {"lidar": Lidar3dSpec(kind="lidar3d", topic="/points")}
    sensors |= {name: Lidar2dSpec(kind="lidar2d", topic=f"/{name}") for name in ("front", "left", "rear")}
    return Rig(root="lidar", target=Board(size=(1, 1)), sensors=sensors, capture=Capture.model_validate(capture))


def times(stamps: Array = STAMPS, message: str = "LaserScan") -> SensorTimes:
    return SensorTimes(stamps, 0.0, np.zeros(len(stamps)), "", message)


def timeline(triggers: tuple[float, ...] = (), **changed: SensorTimes) -> RecordingTimeline:
    sensors = {"lidar": times(message="PointCloud"), "front": times(), "left": times(), "rear": times()}
    return RecordingTimeline(100.0, sensors | changed, np.array(triggers))


def test_a_recording_that_fits_passes() -> None:
    check_timeline(rig(background=[0.0, 5.0], trigger="/go"), timeline((120.0,)), 160.0)


@pytest.mark.parametrize("name", ["lidar", "front", "left", "rear"])
@pytest.mark.parametrize("shift", [-61.0, 61.0])
def test_a_sensor_with_another_clock_is_named(name: str, shift: float) -> None:
    message = "PointCloud" if name == "lidar" else "LaserScan"
    first, last = 100.0 + shift, 159.5 + shift
    reason = rf"sensors\.{name}: its header stamps run from {first:.3f} to {last:.3f} s, .* 100\.000 to 159\.500 s"
    with pytest.raises(InputError, match=reason) as error:
        check_timeline(rig(), timeline((), **{name: times(STAMPS + shift, message)}), 160.0)
    assert "clocks differ" in str(error.value)


@pytest.mark.parametrize("shift", [-59.5, 0.0, 59.5])
def test_sensors_that_overlap_in_time_pass(shift: float) -> None:
    check_timeline(rig(), timeline(front=times(STAMPS + shift)), 160.0)


def test_a_sensor_may_overlap_with_triggers_only() -> None:
    check_timeline(rig(trigger="/go"), timeline((300.0,), front=times(STAMPS + 200)), 400.0)


def test_sensors_without_messages_pass() -> None:
    check_timeline(rig(), timeline(front=times(np.zeros(0), "")), 160.0)


@pytest.mark.parametrize("count", [2, 7])
def test_stamps_that_stand_still_are_named(count: int) -> None:
    with pytest.raises(
        InputError, match=rf"sensors\.left: all its {count} messages have the header stamp 130\.000 s"
    ):
        check_timeline(rig(), timeline(left=times(np.full(count, 130.0))), 160.0)


def test_a_single_message_may_have_one_stamp() -> None:
    check_timeline(rig(), timeline(left=times(np.array([130.0]))), 160.0)


def test_messages_of_another_kind_are_named_with_their_sender() -> None:
    reason = r"sensors\.lidar\.topic: /points has LaserScan messages; a lidar2d sends those, but its kind lidar3d "
    with pytest.raises(InputError, match=reason + "needs PointCloud"):
        check_timeline(rig(), timeline(lidar=times()), 160.0)
    with pytest.raises(InputError, match="/front has Imu messages, but its kind lidar2d needs LaserScan or Poi"):
        check_timeline(rig(), timeline(front=times(message="Imu")), 160.0)


def test_2d_scanners_may_send_clouds() -> None:
    check_timeline(rig(), timeline(front=times(message="PointCloud")), 160.0)


def test_the_trigger_is_no_sensor() -> None:
    with pytest.raises(InputError, match=r"capture\.trigger: /rear is the topic of the sensor rear"):
        check_timeline(rig(trigger="/rear"), timeline(), 160.0)


@pytest.mark.parametrize(("first", "wrong"), [(59.9, False), (60.0, True), (70.0, True)])
def test_the_background_window_lies_in_the_recording(first: float, wrong: bool) -> None:
    checked = rig(background=[first, first + 5])
    if not wrong:
        check_timeline(checked, timeline(), 160.0)
        return
    with pytest.raises(InputError, match=rf"\[{first:g}, {first + 5:g}\] s .* recording, which is 60\.0 s long"):
        check_timeline(checked, timeline(), 160.0)


@pytest.mark.parametrize("order", [1.0, -1.0])
def test_snapshots_of_one_pose_need_no_common_time(order: float) -> None:
    """One message of each sensor: 11 ms between them are no other clock, and more than the longest gap are."""
    single = {name: times(np.array([100.0])) for name in ("left", "rear")}
    single["lidar"] = times(np.array([100.0]), "PointCloud")
    check_timeline(rig(), timeline((), **single, front=times(np.array([100.0 + order * 0.011]))), 100.0)
    with pytest.raises(InputError, match="their clocks differ"):
        check_timeline(rig(), timeline((), **single, front=times(np.array([100.0 + order * 1.1]))), 100.0)


def test_a_recording_without_messages_is_refused_by_its_topics() -> None:
    nothing = {name: times(np.zeros(0), "") for name in ("lidar", "front", "left", "rear")}
    with pytest.raises(InputError, match=r"no message of any sensor \(/points, /front, /left, /rear\): .*inspect"):
        check_timeline(rig(background=[0.0, 5.0]), timeline((), **nothing), 100.0)


def check_numbers(front: Array, left: Array, time_base: TimeBase = "pose") -> None:
    """Files of two scanners with these numbers, which are stamps 10 s apart; the other two sensors have none."""
    nothing = times(np.zeros(0))
    counted = timeline(lidar=nothing, rear=nothing, front=times(10.0 * front), left=times(10.0 * left))
    topics = [TopicInfo(topic, "scan", 1, time_base) for topic in rig().topics.values()]
    check_pose_numbers(rig(), counted, topics)


def test_files_that_share_no_number_are_of_no_pose() -> None:
    reason = "sensors.front: its files have the numbers 101 to 120, those of the others 2041 to 2062: files of one"
    with pytest.raises(InputError, match=reason):
        check_numbers(np.arange(101.0, 121), np.arange(2041.0, 2063))


def test_files_may_share_some_numbers() -> None:
    check_numbers(np.arange(101.0, 121), np.arange(115.0, 130))


def test_stamps_of_a_clock_are_no_numbers() -> None:
    check_numbers(np.arange(101.0, 121), np.arange(2041.0, 2063), time_base="clock")
