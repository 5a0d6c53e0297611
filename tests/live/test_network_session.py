"""A live session of a network: when it calibrates, and what it states."""

from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.live.floor_grid import FloorGrid
from calgraph.live.network_session import NetworkSession
from calgraph.live.network_solution import LiveNetworkSolution
from calgraph.live.sensor_solution import SensorSolution
from calgraph.live.session import SessionPools
from calgraph.live.source import LiveMessage
from calgraph.sensors import LaserScan
from live_sessions import WaitingExecutor, make_live_message

EPOCH = 1_700_000_000.0
NAMES = ("a", "b", "c")
RIG = Rig.model_validate(
    {
        "root": "a",
        "target": {"kind": "people"},
        "sensors": {name: {"kind": "lidar2d", "topic": f"/{name}", "noise": {"range": 0.01}} for name in NAMES},
    }
)


def posed(name: str, grade: str, uncertainty: float, reason: str = "") -> SensorSolution:
    """A scanner with a pose, standard deviations of 2 mm and 2 mrad."""
    covariance, stddev = np.eye(3) * 4e-6, np.full(6, 0.002)
    return SensorSolution(name, "lidar2d", np.eye(4), stddev, covariance, uncertainty, grade, reason)


class Fed:
    """A session, its process, and its clock; messages are fed at 10 Hz of each scanner."""

    def __init__(self) -> None:
        self.pool = WaitingExecutor()
        self.now = 1000.0
        self.recorded = 0.0
        """s"""
        pools = SessionPools(WaitingExecutor(), 1, self.pool, lambda function: function())
        self.lines: list[str] = []
        self.session = NetworkSession(
            RIG, "test", pools, Path("recording"), self.lines.append, clock=lambda: self.now
        )

    def feed(self, seconds: float, names: tuple[str, ...] = NAMES, delay: dict[str, float] | None = None) -> None:
        for _ in range(round(10 * seconds)):
            for name in names:
                self.session.feed(scan(name, self.recorded, (delay or {}).get(name, 0.0)))
            self.recorded += 0.1
            self.now += 0.1


def scan(name: str, at: float, delay: float = 0.0) -> LiveMessage:
    message = LaserScan(EPOCH + at - delay, name, np.linspace(-1, 1, 3), np.full(3, 2.0))
    return make_live_message(f"/{name}", message, EPOCH + at)


def solution(end: float, *scanners: SensorSolution, seconds: float = 1.0) -> LiveNetworkSolution:
    """One of three scanners without poses, if none are given."""
    known = scanners or tuple(SensorSolution(name, "lidar2d") for name in NAMES)
    return LiveNetworkSolution(known, None, EPOCH, EPOCH + end, end, end, seconds=seconds)


@pytest.fixture
def fed() -> Fed:
    return Fed()


def test_the_first_solution_begins_after_eight_seconds(fed: Fed) -> None:
    fed.feed(7.9)
    assert not fed.pool.calls
    fed.feed(0.3)
    assert len(fed.pool.calls) == 1
    assert fed.session.busy


def test_one_solution_is_computed_at_a_time(fed: Fed) -> None:
    fed.feed(60)
    assert len(fed.pool.calls) == 1


def test_the_process_rests_as_long_as_it_worked(fed: Fed) -> None:
    fed.feed(30)
    fed.pool.finish(solution(8.0))
    fed.feed(20)
    assert len(fed.pool.calls) == 1
    fed.feed(4)
    assert len(fed.pool.calls) == 2


def test_nothing_is_computed_without_new_messages(fed: Fed) -> None:
    fed.feed(9)
    fed.pool.finish(solution(9.0))
    fed.now += 100
    fed.feed(0.1)
    assert len(fed.pool.calls) == 1
    fed.feed(3)
    assert len(fed.pool.calls) == 2


def test_the_last_solution_is_given_to_the_next(fed: Fed) -> None:
    fed.feed(9)
    assert fed.pool.calls[0][2][2] is None
    fed.pool.finish(None)
    fed.feed(5)
    found = solution(14.0)
    fed.pool.finish(found)
    fed.feed(5)
    assert fed.pool.calls[-1][2][2] is found


def test_poses_within_tolerance_are_printed_once(fed: Fed) -> None:
    good = tuple(posed(name, "good", 0.5) for name in NAMES)
    fed.feed(9)
    fed.pool.finish(solution(9.0))
    for end in (20.0, 40.0):
        assert len(fed.lines) == (end > 20)
        fed.feed(20)
        fed.pool.finish(solution(end, *good))
    assert fed.lines == ["All sensors are within tolerance: finish"]


def test_scanners_without_messages_are_named(fed: Fed) -> None:
    fed.feed(1, ("a", "c"))
    state = fed.session.state()
    assert state.phase == "connecting"
    assert state.headline == "Waiting for messages of b"
    assert [sensor.rate for sensor in state.sensors] == pytest.approx([10, 0, 10])


def test_silent_scanners_are_named(fed: Fed) -> None:
    fed.feed(1)
    fed.feed(3, ("a", "b"))
    state = fed.session.state()
    assert state.headline == "c: no messages any more"
    assert state.sensors[2].problem == "has sent no message for 3 s"


def test_a_clock_that_differs_from_the_others_is_named(fed: Fed) -> None:
    fed.feed(2, delay={"b": 7.0, "c": 0.05})
    assert [sensor.problem for sensor in fed.session.state().sensors] == [
        "", "has a clock that is 7.0 s late", "",
    ]  # fmt: skip


def test_unusable_messages_are_counted(fed: Fed) -> None:
    fed.feed(1)
    for _ in range(2):
        fed.session.feed(replace(scan("b", 1.0), data=b"\x00\x01"))
    assert fed.session.state().sensors[1].problem.startswith("2 unusable messages: ")


def test_people_are_sent_to_scanners_that_have_detected_no_person(fed: Fed) -> None:
    fed.feed(9)
    apart = SensorSolution("c", "lidar2d", reason="no object of the target's size was detected")
    fed.pool.finish(solution(9.0, posed("a", "good", 0.0), SensorSolution("b", "lidar2d", tracks=3), apart))
    state = fed.session.state()
    assert state.headline == "Walk where c detects you, and on to where another sensor does"
    assert state.advice is not None
    assert "b and another sensor both detect you" in state.advice.text
    assert "(no object of the target's size was detected)" in state.advice.text


def test_the_time_that_is_left_is_stated(fed: Fed) -> None:
    fed.feed(60)
    weak = posed("b", "weak", 2.0, "±2 cm")
    fed.pool.finish(solution(60.0, posed("a", "good", 0.0), weak))
    state = fed.session.state()
    assert state.headline == "Walk where several sensors detect you, for b: about 3 minutes more"
    assert state.advice is not None
    assert state.advice.expected == "within tolerance in about 3 minutes"
    assert not state.done


@pytest.mark.parametrize(
    ("advice", "headline", "expected"),
    [
        ("let people walk farther", "Walk where several sensors detect you, for b: about 3 minutes more", True),
        ("measure it", "For b: measure it (the largest source: ranges (93 %))", False),
    ],
)
def test_the_headline_has_the_remedy_of_the_largest_source(
    fed: Fed, advice: str, headline: str, expected: bool
) -> None:
    """Walks and their minutes only where they help."""
    fed.feed(60)
    weak = posed("b", "weak", 2.0, f"x ±20 mm; the largest source of it: ranges (93 %); {advice}")
    fed.pool.finish(solution(60.0, posed("a", "good", 0.0), weak))
    state = fed.session.state()
    assert state.headline == headline
    assert state.advice is not None
    assert bool(state.advice.expected) == expected


def test_walks_are_for_those_that_they_help(fed: Fed) -> None:
    """No time is stated until all are within the tolerance, where that of one is not a matter of walks."""
    fed.feed(60)
    helped = posed("b", "weak", 2.0, "x ±20 mm; the largest source of it: walks (93 %); let people walk farther")
    other = posed("c", "weak", 3.0, "x ±30 mm; the largest source of it: ranges (93 %); measure it")
    fed.pool.finish(solution(60.0, posed("a", "good", 0.0), helped, other))
    state = fed.session.state()
    assert state.headline == "Walk where several sensors detect you, for b: about 3 minutes more"
    assert state.advice is not None
    assert state.advice.expected == ""


def test_it_is_done_when_all_scanners_are_good(fed: Fed) -> None:
    fed.feed(9)
    cells = np.zeros((2, 2), dtype=np.bool_)
    floor = FloorGrid(np.zeros(2), 0.5, cells, cells, np.zeros((1, 2)))
    fed.pool.finish(replace(solution(9.0, *(posed(name, "good", 0.4) for name in NAMES)), grid=floor))
    state = fed.session.state()
    assert state.done
    assert state.phase == "ready"
    assert state.advice is None
    assert state.sensors[0].stddev_mm is None
    assert state.sensors[1].stddev_mm == pytest.approx(2)
    assert state.sensors[1].stddev_degrees == pytest.approx(np.degrees(0.002))
    assert state.scene is not None
    assert state.scene.floor is floor
    assert tuple(one.name for one in state.scene.sensors) == NAMES


def test_the_state_says_that_solutions_are_late(fed: Fed) -> None:
    fed.feed(9)
    fed.pool.finish(solution(9.0))
    fed.feed(10)
    assert fed.session.state().notices == ()
    fed.feed(30)
    (notice,) = fed.session.state().notices
    assert notice == "Poses and plan are 40 s old: the computer is slower than the scanners"


def test_the_state_says_of_how_much_the_poses_are(fed: Fed) -> None:
    fed.feed(9)
    fed.pool.finish(replace(solution(2400.0), used=600.0))
    (notice,) = fed.session.state().notices
    assert notice == "Poses are of 10 of 40 minutes: all are calibrated at the end"


def test_an_error_is_stated_and_the_next_solution_follows(fed: Fed) -> None:
    fed.feed(9)
    fed.pool.finish(RuntimeError("no memory"))
    assert fed.session.state().headline == "No poses from what was recorded until now: no memory"
    fed.feed(5)
    fed.pool.finish(solution(14.0))
    assert "no memory" not in fed.session.state().headline


def test_only_recording_goes_on_where_the_process_was_killed(fed: Fed) -> None:
    fed.feed(9)
    fed.pool.finish(BrokenProcessPool("a process was terminated abruptly"))
    fed.feed(30)
    assert len(fed.pool.calls) == 1
    assert fed.session.state().headline.startswith("Only recording goes on: a process was killed")


def test_results_are_ignored_after_the_end(fed: Fed) -> None:
    fed.feed(9)
    fed.session.close()
    fed.pool.finish(solution(9.0))
    assert fed.session.solution is None
