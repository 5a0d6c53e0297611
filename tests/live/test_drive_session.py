"""A live session of a robot that drives: what it says of its motion, what to drive, and when it calibrates."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from calgraph.config import Rig
from calgraph.drive.start import MOTION_DURATION
from calgraph.geometry import Array, se3, se_n, so3
from calgraph.live.drive_motion import DriveMotion, list_needs, measure_motions, select_measuring
from calgraph.live.drive_session import DriveSession, LiveDriveSolution
from calgraph.live.sensor_solution import SensorSolution
from calgraph.live.session import SessionPools
from calgraph.live.source import Channel, LiveMessage
from calgraph.live.state import SessionState
from calgraph.recording.message_types import ros2_definition
from calgraph.simulation import STANDARD_RIGS, DriveScenario, simulate_drive
from calgraph.simulation.drive_scenario import DRIVE_KINDS
from calgraph.surfaces.trajectory import Track
from live_sessions import ImmediateExecutor, WaitingExecutor, send_messages

STORE = get_typestore(Stores.ROS2_HUMBLE)
EPOCH = 1_700_000_000.0


def make_rig(**kinds: str) -> Rig:
    sensors = {name: {"kind": kind, "topic": f"/{name}"} for name, kind in kinds.items()}
    return Rig.model_validate({"root": next(iter(kinds)), "target": {"kind": "surroundings"}, "sensors": sensors})


RIG = make_rig(a="trajectory", b="trajectory")


def make_pose_message(topic: str, stamp: float, pose: Array) -> LiveMessage:
    """A geometry_msgs/PoseStamped."""
    types, name = STORE.types, "geometry_msgs/msg/PoseStamped"
    time = types["builtin_interfaces/msg/Time"](int(stamp), round(1e9 * (stamp % 1)))
    point = types["geometry_msgs/msg/Point"](*pose[:3, 3])
    turn = types["geometry_msgs/msg/Quaternion"](*so3.quaternion(pose[:3, :3]))
    message = types[name](types["std_msgs/msg/Header"](time, "odom"), types["geometry_msgs/msg/Pose"](point, turn))
    definition = ros2_definition(name)
    assert definition
    channel = Channel(topic, name, "cdr", "ros2msg", definition.text)
    return LiveMessage(channel, round(1e9 * stamp), bytes(STORE.serialize_cdr(message, name)))


class Driven:
    """A session of a robot with two trajectories; motion is measured at once, and calibrations wait."""

    def __init__(self) -> None:
        self.pool, self.now, self.pose = WaitingExecutor(), 0.0, np.eye(4)
        pools = SessionPools(ImmediateExecutor(), 1, self.pool, lambda function: function())
        self.session = DriveSession(RIG, "test", pools, Path("recording"), lambda _: None, clock=lambda: self.now)

    def drive(self, seconds: float, speed: float, yaw: float, pitch: float = 0.0, names: str = "ab") -> None:
        """Drives ahead, m/s, and turns to the left and down, degrees/s."""
        turn = np.radians([0, pitch, yaw]) / 20
        step = se3.pose(so3.exp(turn), np.array([speed / 20, 0, 0]))
        for _ in range(round(20 * seconds)):
            for name in names:
                self.session.feed(make_pose_message(f"/{name}", EPOCH + self.now, self.pose))
            self.pose, self.now = self.pose @ step, self.now + 0.05

    def state(self) -> SessionState:
        return self.session.state()


def amounts(state: SessionState) -> dict[str, str]:
    return {need.label: need.text for need in state.needs}


def posed(name: str, grade: str, reason: str = "") -> SensorSolution:
    return SensorSolution(name, "trajectory", np.eye(4), np.full(6, 0.002), np.eye(3) * 4e-6, 1.0, grade, reason)


@pytest.fixture
def driven() -> Driven:
    return Driven()


def test_turns_and_way_are_shown_and_what_to_drive_next(driven: Driven) -> None:
    driven.drive(15, 0.4, yaw=-12)
    state = driven.state()
    assert state.headline == "Turn more to the left"
    assert state.advice is not None
    assert state.advice.text == (
        "turn more to the left; travel further; turn about another axis: drive over a ramp; drive on: 15 of 30 s"
    )
    found = amounts(state)
    assert found["Turned left"] == "0 of 90°"
    # The last motions end later than what was driven, and the first begin half a second after its start.
    assert int(found["Turned right"].split()[0]) in range(125, 160)
    assert found["Travelled"] in {"4 of 10 m", "5 of 10 m", "6 of 10 m"}
    assert found["About another axis"].startswith("0.0 of")
    assert not driven.pool.calls


def test_turns_to_the_left_and_over_ramps_suffice(driven: Driven) -> None:
    driven.drive(12, 0.6, yaw=-12)
    driven.drive(14, 0.6, yaw=12)
    assert driven.state().headline == "Turn about another axis: drive over a ramp"
    for _ in range(2):
        driven.drive(1.5, 0.6, yaw=0, pitch=-4)
        driven.drive(1.5, 0.6, yaw=0, pitch=4)
    driven.drive(3, 0.6, yaw=0)
    state = driven.state()
    assert [need.done for need in state.needs] == [True] * 5


def test_it_calibrates_by_itself_when_the_robot_has_moved_enough(driven: Driven) -> None:
    driven.drive(20, 0.5, yaw=-12)
    driven.drive(13, 0.5, yaw=12)
    assert len(driven.pool.calls) == 1
    assert driven.state().headline == "What was recorded is being calibrated: drive on"
    found = LiveDriveSolution((posed("a", "good"), posed("b", "weak", "±2 cm: drive loops")), EPOCH + 32)
    driven.pool.finish(found)
    state = driven.state()
    assert state.headline == "Turn about another axis: drive over a ramp, for b"
    assert state.advice is not None
    assert state.advice.text == "turn about another axis: drive over a ramp; ±2 cm: drive loops"
    assert state.scene is not None
    driven.drive(8, 0.5, yaw=12)
    assert len(driven.pool.calls) == 1
    driven.drive(3, 0.5, yaw=12)
    assert len(driven.pool.calls) == 2
    driven.pool.finish(LiveDriveSolution((posed("a", "good"), posed("b", "good")), EPOCH + 43))
    driven.drive(30, 0.5, yaw=12)
    assert driven.state().done
    assert driven.state().headline == "All sensors are within tolerance: finish"
    assert len(driven.pool.calls) == 2


def test_a_button_calibrates_what_was_recorded(driven: Driven) -> None:
    driven.drive(5, 0.5, yaw=0)
    driven.session.command("trigger")
    assert len(driven.pool.calls) == 1
    driven.pool.finish(LiveDriveSolution((), EPOCH + 5, "it has 10 sweeps"))
    assert driven.state().headline == "No poses yet: it has 10 sweeps"


def test_sensors_that_send_nothing_are_named(driven: Driven) -> None:
    driven.drive(1, 0.5, yaw=0, names="a")
    assert driven.state().headline == "Waiting for messages of b"
    driven.drive(1, 0.5, yaw=0)
    driven.drive(3, 0.5, yaw=0, names="a")
    assert driven.state().headline == "b: no messages any more"


def test_a_trajectory_that_is_not_usable_is_stated(driven: Driven) -> None:
    for _ in range(140):
        driven.pose = se3.pose(np.eye(3), np.array([np.nan, 0, 0]))
        driven.drive(0.05, 0, yaw=0)
    assert driven.state().notices == ("Turns and way are not known: a: it has 0 usable poses; a drive needs 50",)


def test_motion_is_told_by_the_root_if_it_can() -> None:
    assert select_measuring(make_rig(a="trajectory", b="lidar3d")) == "a"
    assert select_measuring(make_rig(a="trajectory", b="gyroscope", c="lidar3d")) == "a"
    assert select_measuring(make_rig(a="lidar2d", b="lidar2d")) == "a"
    assert select_measuring(make_rig(a="lidar2d", b="lidar3d")) == "b"


def test_gyroscopes_tell_turns_only() -> None:
    rig = make_rig(b="trajectory", a="gyroscope")
    motion = DriveMotion(np.arange(4.0), np.tile(se3.pose(so3.exp(np.array([0, 0, 0.3])), np.zeros(3)), (4, 1, 1)))
    labels = [need.label for need in list_needs(rig, 2.0, motion, "a")]
    assert labels == ["Turned left", "Turned right", "About another axis", "Time"]


@pytest.mark.slow
def test_a_played_drive_turns_and_travels_as_its_truth() -> None:
    drive = simulate_drive(DriveScenario(7, 16.0, STANDARD_RIGS["two_lidars"]))
    rig = make_rig(**{one.name: DRIVE_KINDS[one.kind] for one in drive.scenario.sensors})
    found = measure_motions(
        rig, rig.root, "test", list(send_messages(drive.recording, [drive.topics[rig.root]])), -np.inf
    )
    assert isinstance(found, DriveMotion)
    assert len(found.starts) >= 26
    truth = Track(drive.truth.times, drive.truth.T_world_root)
    motions = np.linalg.inv(truth.at(found.starts)) @ truth.at(found.starts + MOTION_DURATION)
    turns = se_n.log(se_n.rotation(found.motions)) - so3.log(motions[:, :3, :3])
    assert np.degrees(np.median(np.abs(turns).max(axis=1))) < 0.5
    ways = np.linalg.norm(se_n.translation(found.motions), axis=1) - np.linalg.norm(motions[:, :3, 3], axis=1)
    assert np.median(np.abs(ways)) < 0.05
    measured, true = (
        {need.label: need.progress for need in list_needs(rig, 16.0, one, rig.root)}
        for one in (found, DriveMotion(found.starts, motions))
    )
    for label, progress in measured.items():
        assert progress == pytest.approx(true[label], abs=0.1), label
    assert max(measured["Turned left"], measured["Turned right"]) > 1
