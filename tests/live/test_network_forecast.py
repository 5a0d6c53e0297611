"""Minutes that people still have to walk, from how the uncertainties fell."""

import numpy as np
import pytest

from calgraph.config.settings import LiveNetworkSettings
from calgraph.live.network_session import Forecast
from calgraph.live.network_solution import LiveNetworkSolution
from calgraph.live.sensor_solution import SensorSolution


def solution(seconds: float, **uncertainties: float) -> LiveNetworkSolution:
    scanners = tuple(
        SensorSolution(name, "lidar2d", T_root_sensor=np.eye(4), uncertainty=value)
        for name, value in uncertainties.items()
    )
    return LiveNetworkSolution(
        (*scanners, SensorSolution("apart", "lidar2d")), None, 100.0, 100.0 + seconds, seconds, seconds
    )


def forecast(*solutions: LiveNetworkSolution) -> float | None:
    found = Forecast(LiveNetworkSettings())
    for one in solutions:
        found.add(one)
    return found.minutes_left([one.name for one in solutions[-1].posed] if solutions else [])


def test_uncertainties_fall_with_the_root_of_the_time() -> None:
    assert forecast(solution(60, a=2)) == pytest.approx(3)


def test_the_worst_scanner_counts() -> None:
    assert forecast(solution(60, a=2, b=3, c=0.5)) == pytest.approx(8)


def test_others_than_those_of_interest_do_not_count() -> None:
    found = Forecast(LiveNetworkSettings())
    found.add(solution(60, a=2, b=3))
    assert found.minutes_left(["a"]) == pytest.approx(3)


def test_a_slower_decay_is_measured() -> None:
    # With the power 1/4 of the time: from 2 to 1 in 16 times the time.
    assert forecast(solution(10, a=2 * 2**0.5), solution(40, a=2)) == pytest.approx(40 * 15 / 60)


def test_a_faster_decay_is_not_trusted() -> None:
    assert forecast(solution(10, a=50), solution(60, a=2)) == pytest.approx(3)


def test_nothing_is_left_within_the_tolerance() -> None:
    assert forecast(solution(60, a=0.9)) == 0


@pytest.mark.parametrize(
    "solutions",
    [
        (),
        (solution(60),),
        (solution(10, a=2), solution(60, a=2)),
        (solution(10, a=2), solution(60, a=2.5)),
        (solution(60, a=50),),
    ],
    ids=["no solution", "no pose", "constant", "rising", "hours"],
)
def test_no_time_is_stated_where_it_would_be_a_guess(solutions: tuple[LiveNetworkSolution, ...]) -> None:
    assert forecast(*solutions) is None


def test_a_solution_of_the_same_messages_replaces_the_last() -> None:
    assert forecast(solution(60, a=4), solution(60, a=2)) == pytest.approx(3)
