"""Findings about bumped scanners."""

import numpy as np
import pytest

from calgraph.errors import Rejected
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.checks.findings import collect_network_findings, describe_bumps
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.tracking.track import ScannerBump, ScannerTracks
from calgraph.result.finding import Finding

START = 1000.0
BUMP = ScannerBump((START + 30.2, START + 30.4), 0.03, np.radians(1.0), 0.002, np.radians(0.05))


def tracks(
    bumps: tuple[ScannerBump, ...] = (), interval: tuple[float, float] = (-np.inf, np.inf)
) -> ScannerTracks:
    return ScannerTracks((), np.zeros((0, 2)), 0.01, None, bumps, interval)


def describe(bumped: str, one: ScannerTracks) -> Finding:
    """The finding about a scanner of a network whose root is west."""
    followed: dict[str, ScannerTracks | Rejected] = dict.fromkeys(("west", "east"), tracks())
    followed |= {bumped: one, "north": Rejected("no scan has any beam")}
    (finding,) = describe_bumps("west", followed, START)
    return finding


def test_scanners_at_rest_have_no_finding() -> None:
    assert describe_bumps("west", {"west": tracks(), "east": Rejected("none")}, START) == ()


def test_scanner_size_time_and_data_are_stated() -> None:
    finding = describe("east", tracks((BUMP,), (START + 30.7, np.inf)))
    assert finding.text == (
        "east moved by 30 ± 2 mm and +1.00 ± 0.05° (σ) at 30.3 s: the result is its pose after that, "
        "from its data after 30.7 s"
    )


@pytest.mark.parametrize("name", ["east", "west"])
def test_a_pose_from_after_the_bump_is_not_weak(name: str) -> None:
    assert describe(name, tracks((BUMP,), (START + 30.7, np.inf))).sensors == ()


def test_the_frame_of_a_bumped_root_is_stated() -> None:
    assert (
        "all poses are in its frame at that time" in describe("west", tracks((BUMP,), (START + 30.7, np.inf))).text
    )


def test_a_pose_from_before_the_last_bump_is_weak() -> None:
    finding = describe("east", tracks((BUMP,), (START, START + 29.9)))
    assert "between 0.0 and 29.9 s" in finding.text
    assert finding.sensors == ("east",)


def test_all_poses_are_weak_if_the_root_has_moved_since() -> None:
    assert describe("west", tracks((BUMP,), (START, START + 29.9))).sensors == ("west", "east", "north")


def test_the_root_of_the_result_may_be_any_scanner() -> None:
    """Also where poses are averaged in the frame of another, the first."""
    followed = {"west": tracks(), "east": tracks((BUMP,), (START, START + 29.9))}
    T = np.tile(np.eye(3), (2, 1, 1))
    graph = PoseGraph(2, np.array([[0, 1]]), T[:1], T[:1])
    averaged = NetworkInitialization({}, graph, ("west", "east"), PoseGraphSolution(T, np.array([True])))
    (finding,) = collect_network_findings("east", followed, averaged, START)
    assert finding.sensors == ("west", "east")


def test_several_bumps_are_one_finding() -> None:
    later = ScannerBump((START + 40.0, START + 41.0), 0.1, 0.0, 0.002, 0.001)
    assert describe("east", tracks((BUMP, later), (START + 41.2, np.inf))).text.count(" mm and ") == 2


def test_a_bump_without_common_background_has_no_size() -> None:
    far = ScannerBump((START + 30.2, START + 30.4), np.nan, np.nan, 0.0, 0.0)
    assert (
        "by more than its background determines" in describe("east", tracks((far,), (START + 30.7, np.inf))).text
    )
