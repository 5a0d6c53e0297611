import numpy as np
import pytest

from calgraph.geometry import so3
from calgraph.simulation.motion import (
    BoardPlacement,
    BoardTrajectory,
    displace_board,
    draw_placements,
    place_all_boards,
    pose_from_placement,
    schedule_holds,
)


def placements(rng: np.random.Generator) -> tuple[BoardPlacement, ...]:
    return draw_placements(rng, np.radians([-40, 0, 60]).tolist(), [1.5, 2.5], 2, np.radians(30), (0.7, 1.1))


def trajectory(rng: np.random.Generator, disturbed: int = 0) -> BoardTrajectory:
    places = placements(rng)
    after_slip = [displace_board(s, rng, 0.06, 0.07) if i < disturbed else None for i, s in enumerate(places)]
    return schedule_holds(
        places, background=5.0, move_time=0.8, hold_end=lambda start: start + 2.0, placements_after_slip=after_slip
    )


def test_unrotated_board_faces_the_robot_upright() -> None:
    T = pose_from_placement(
        BoardPlacement(bearing=np.radians(90), radius=2.0, height=1.0, R_facing_board=np.eye(3))
    )
    # Ahead of the reader is +y, so the reader's right is +x.
    expected = np.array([[1, 0, 0, 0], [0, 0, -1, 2], [0, 1, 0, 1], [0, 0, 0, 1]])
    assert pytest.approx(expected, abs=1e-12) == T


def test_placements_cover_every_bearing_radius_and_sample(rng: np.random.Generator) -> None:
    assert len(placements(rng)) == 3 * 2 * 2
    assert {round(np.degrees(s.bearing)) for s in placements(rng)} == {-40, 0, 60}


def test_rotations_stay_below_the_largest(rng: np.random.Generator) -> None:
    drawn = draw_placements(rng, [0.0], [2.0], 500, 0.3, (1.0, 1.0))
    angles = np.linalg.norm(so3.log(np.stack([s.R_facing_board for s in drawn])), axis=1)
    assert 0.35 < angles.max() <= 0.3 * np.sqrt(3) * 1.05


def test_board_is_absent_during_the_background_window(rng: np.random.Generator) -> None:
    assert trajectory(rng).placement_at(4.99) is None


def test_board_rests_through_every_hold(rng: np.random.Generator) -> None:
    walk = trajectory(rng)
    for hold in walk.holds:
        times = np.linspace(hold.start, hold.end, 20)
        assert all(walk.placement_at(float(t)) is hold.placement for t in times[:-1])
        assert walk.is_static(hold.start, hold.end)


def test_board_moves_between_holds(rng: np.random.Generator) -> None:
    walk = trajectory(rng)
    assert not any(walk.is_static(a.end - 0.1, a.end + 0.1) for a in walk.holds[:-1])


def test_moves_start_and_end_smoothly(rng: np.random.Generator) -> None:
    walk = trajectory(rng)
    end = walk.holds[3].end
    positions = []
    for t in (end, end + 0.01, end + 0.4, end + 0.41):
        placement = walk.placement_at(t)
        assert placement is not None
        positions.append(pose_from_placement(placement)[:3, 3])
    first, fastest = (float(np.linalg.norm(positions[i + 1] - positions[i])) for i in (0, 2))
    assert first < 0.01 * fastest


def test_disturbed_hold_shows_two_poses_as_far_apart_as_stated(rng: np.random.Generator) -> None:
    walk = trajectory(rng, disturbed=1)
    hold = walk.holds[0]
    before, after = walk.placement_at(hold.start + 0.5), walk.placement_at(hold.end - 0.3)
    assert before is not None
    assert after is not None
    step = pose_from_placement(after)[:3, 3] - pose_from_placement(before)[:3, 3]
    assert np.linalg.norm(step) == pytest.approx(0.06, rel=0.02)
    assert not walk.is_static(hold.start, hold.end)


def test_walk_between_opposite_bearings_goes_around_the_robot() -> None:
    ends = [BoardPlacement(np.radians(b), 2.0, 1.0, np.eye(3)) for b in (-90, 90)]
    walk = schedule_holds(
        ends, background=1.0, move_time=1.0, hold_end=lambda start: start + 1, placements_after_slip=[None, None]
    )
    for t in np.linspace(walk.holds[0].end, walk.holds[1].start, 30, endpoint=False):
        placement = walk.placement_at(float(t))
        assert placement is not None
        assert np.hypot(*pose_from_placement(placement)[:2, 3]) == pytest.approx(2.0)


def test_a_slip_begins_in_the_middle_of_its_hold_and_lasts_three_tenths_of_a_second(
    rng: np.random.Generator,
) -> None:
    walk = trajectory(rng, disturbed=1)
    middle = (walk.holds[0].start + walk.holds[0].end) / 2
    moving = [walk.is_static(middle + t, middle + t + 0.01) for t in (-0.02, 0.01, 0.28, 0.31)]
    assert moving == [True, False, False, True]


def test_further_boards_stand_50_degrees_apart_with_alternating_rotations() -> None:
    R = so3.exp(np.array([0.1, 0.2, 0.3]))
    boards = place_all_boards(BoardPlacement(0.2, 2.0, 1.0, R), 3)
    np.testing.assert_allclose([board.bearing for board in boards], 0.2 + np.radians([0, 50, 100]))
    np.testing.assert_array_equal([board.R_facing_board for board in boards], [R, R.T, R])
