"""Where people walked, and where they should still walk."""

from collections.abc import Collection

import numpy as np
import pytest

from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.live.floor_grid import _MAX_CELLS, Cells, FloorGrid, build_floor_grid, is_helped_by_walks
from calgraph.network.tracking.track import ScannerTracks, Track
from calgraph.result import Calibration, Evidence, FloorView, Pictures, SensorPose, Verdict

# The room is 10 m by 6 m; scanners are in the middle of its left and of its right wall.
ROOM = (0.0, 10.0, -3.0, 3.0)
POSES = {"left": se2.pose(0.0, np.array([0.02, 0.0])), "right": se2.pose(np.pi, np.array([9.98, 0.0]))}


def walls(T_root_scanner: Array) -> Array:
    """(N, 2) where beams of half a degree end on walls, in the scanner's frame."""
    bearing = np.radians(np.arange(-88.75, 89, 0.5))
    origin, theta = T_root_scanner[:2, 2], np.arctan2(T_root_scanner[1, 0], T_root_scanner[0, 0])
    d = np.stack([np.cos(bearing + theta), np.sin(bearing + theta)])
    x0, x1, y0, y1 = ROOM
    ranges = np.minimum(
        (np.where(d[0] > 0, x1, x0) - origin[0]) / d[0], (np.where(d[1] > 0, y1, y0) - origin[1]) / d[1]
    )
    return np.column_stack([ranges * np.cos(bearing), ranges * np.sin(bearing)])


def walk(T_root_scanner: Array, start: tuple[float, float], end: tuple[float, float]) -> Track:
    """Along a line at 1.2 m/s."""
    count = max(2, round(np.linalg.norm(np.subtract(end, start)) / 0.12))
    inside = se2.apply(se2.inverse(T_root_scanner), np.linspace(start, end, count))
    return Track(np.arange(count) / 10, inside, 0 * inside, np.zeros((count, 2, 2)), 0)


def scanner(name: str, *lines: tuple[tuple[float, float], tuple[float, float]]) -> ScannerTracks:
    T = POSES[name]
    return ScannerTracks(tuple(walk(T, *line) for line in lines), walls(T), 0.01)


def build(
    tracked: dict[str, ScannerTracks | Rejected],
    unfinished: Collection[str] = (),
    *,
    connected: int = 2,
    reason: str = "",
) -> FloorGrid | None:
    sensors = tuple(
        SensorPose(
            name,
            None,
            name,
            "lidar2d",
            se2.to_se3(T),
            Verdict("weak", reason) if name in unfinished else Verdict("good"),
        )
        for name, T in list(POSES.items())[:connected]
    )
    apart = {name: found.reason for name, found in tracked.items() if isinstance(found, Rejected)}
    calibration = Calibration(
        "left", sensors, np.zeros((6 * connected, 6 * connected)),
        evidence=Evidence(unconnected=apart),
        pictures=Pictures(floor_views=tuple(draw(one.name, tracked[one.name]) for one in sensors)),
    )  # fmt: skip
    return build_floor_grid(calibration)


def draw(name: str, found: ScannerTracks | Rejected) -> FloorView:
    assert isinstance(found, ScannerTracks)
    T = POSES[name]
    return FloorView(
        name,
        se2.apply(T, found.background),
        tuple(se2.apply(T, track.positions) for track in found.tracks),
        tuple(track.times for track in found.tracks),
    )


def at(grid: FloorGrid, cells: Cells, x: float, y: float) -> bool:
    column, row = ((np.array([x, y]) - grid.origin) / grid.cell).astype(int)
    return bool(cells[column, row])


@pytest.mark.parametrize(
    ("reason", "helped"),
    [
        ("", True),
        ("the joint solution has not converged", True),
        ("x ±20 mm exceeds the tolerance; the largest source of it: walks (90 %); let people walk farther", True),
        ("x ±20 mm exceeds the tolerance; the largest source of it: range errors (90 %); measure ranges", False),
        ("x ±20 mm; the largest source of it: noise (90 %); record 60 s more of people who walk like these", True),
        ("matches, too: let people walk alone; the largest source of it: range errors (90 %); measure it", True),
        ("of people who walk so: set clocks; the largest source of it: range errors (90 %); measure it", False),
    ],
)
def test_people_are_to_walk_where_that_helps(reason: str, helped: bool) -> None:
    assert is_helped_by_walks(reason) == helped
    tracked: dict[str, ScannerTracks | Rejected] = {"left": scanner("left", LINE), "right": scanner("right", LINE)}
    grid = build(tracked, ("right",), reason=reason)
    assert grid is not None
    assert grid.wanted.any() == helped


LINE = ((3.0, 2.0), (7.0, 2.0))


@pytest.fixture
def both() -> dict[str, ScannerTracks | Rejected]:
    """Both scanners tracked somebody along a line."""
    return {"left": scanner("left", LINE), "right": scanner("right", LINE)}


def test_walks_and_walls_are_in_the_frame_of_the_root(both: dict[str, ScannerTracks | Rejected]) -> None:
    grid = build(both)
    assert grid is not None
    assert at(grid, grid.walked, 5.0, 2.0)
    assert not at(grid, grid.walked, 5.0, 0.0)
    assert np.ptp(grid.walls, axis=0) == pytest.approx([10, 6], abs=0.1)


def test_people_should_walk_where_an_unfinished_scanner_and_another_see_them(
    both: dict[str, ScannerTracks | Rejected],
) -> None:
    grid = build(both, ["right"])
    assert grid is not None
    assert at(grid, grid.wanted, 5.0, -1.0)
    # Walked already; 9 m from the other scanner; close to the wall.
    assert not at(grid, grid.wanted, 5.0, 2.0)
    assert not at(grid, grid.wanted, 9.2, 0.0)
    assert not at(grid, grid.wanted, 5.0, -2.8)


def test_nobody_has_to_walk_for_scanners_within_tolerance(both: dict[str, ScannerTracks | Rejected]) -> None:
    grid = build(both)
    assert grid is not None
    assert not grid.wanted.any()


def test_people_should_go_where_nobody_has_been_to_find_an_unconnected_scanner(
    both: dict[str, ScannerTracks | Rejected],
) -> None:
    grid = build({**both, "apart": Rejected("nobody")})
    assert grid is not None
    assert at(grid, grid.wanted, 9.2, 0.0)
    assert not at(grid, grid.wanted, 5.0, 2.0)


def test_where_all_has_been_walked_the_rest_is_where_that_was_least() -> None:
    lanes = [((2.0, y), (8.0, y)) for y in np.arange(-2.4, 2.5, 0.2)]
    often = [*lanes, *(lane for lane in lanes if lane[0][1] > 0 for _ in range(3))]
    grid = build({"left": scanner("left", *often), "right": scanner("right", *often)}, ["right"])
    assert grid is not None
    assert at(grid, grid.wanted, 5.0, -1.0)
    assert not at(grid, grid.wanted, 5.0, 1.0)


def test_there_is_no_plan_of_one_scanner(both: dict[str, ScannerTracks | Rejected]) -> None:
    assert build(both, connected=1) is None


def test_a_large_building_has_larger_cells(both: dict[str, ScannerTracks | Rejected]) -> None:
    left = both["left"]
    assert isinstance(left, ScannerTracks)
    far = walk(POSES["left"], (0.0, 0.0), (100.0, 0.0))
    grid = build({**both, "left": ScannerTracks((far,), left.background, 0.01)})
    assert grid is not None
    assert max(grid.walked.shape) <= _MAX_CELLS + 1


def test_scanners_that_track_people_far_away_detect_them_there() -> None:
    near, far = ((1.0, 2.0), (3.0, 2.0)), ((9.5, 2.0), (1.0, 2.0))
    left = scanner("left", near)
    assert (short := build({"left": left, "right": scanner("right", near)}, ["left"])) is not None
    assert (wide := build({"left": scanner("left", far), "right": scanner("right", near)}, ["left"])) is not None
    assert not at(short, short.wanted, 8.6, 0.0)
    assert at(wide, wide.wanted, 8.6, 0.0)


def test_beams_that_return_nothing_are_free() -> None:
    def cut(name: str) -> ScannerTracks:
        found = scanner(name, LINE)
        points = found.background
        return ScannerTracks(found.tracks, points[np.linalg.norm(points, axis=1) < 5], 0.01)

    grid = build({"left": cut("left"), "right": cut("right")}, ["right"])
    assert grid is not None
    assert at(grid, grid.wanted, 5.0, 0.0)
