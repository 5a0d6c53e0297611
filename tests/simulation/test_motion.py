import numpy as np
import pytest

from calgraph.geometry import so3
from calgraph.simulation.motion import Stance, Timeline, board_pose, draw_stances, schedule, slip


def stances(rng: np.random.Generator) -> tuple[Stance, ...]:
    return draw_stances(rng, np.radians([-40, 0, 60]).tolist(), [1.5, 2.5], 2, np.radians(30), (0.7, 1.1))


def timeline(rng: np.random.Generator, disturbed: int = 0) -> Timeline:
    places = stances(rng)
    slips = [slip(s, rng, 0.06, 0.07) if i < disturbed else None for i, s in enumerate(places)]
    return schedule(places, background=5.0, move_time=0.8, hold_end=lambda start: start + 2.0, disturbed=slips)


def test_unrotated_board_faces_the_robot_upright() -> None:
    T = board_pose(Stance(bearing=np.radians(90), radius=2.0, height=1.0, R_facing_board=np.eye(3)))
    # Ahead of the reader is +y, so the reader's right is +x.
    expected = np.array([[1, 0, 0, 0], [0, 0, -1, 2], [0, 1, 0, 1], [0, 0, 0, 1]])
    assert pytest.approx(expected, abs=1e-12) == T


def test_stances_cover_every_bearing_radius_and_sample(rng: np.random.Generator) -> None:
    assert len(stances(rng)) == 3 * 2 * 2
    assert {round(np.degrees(s.bearing)) for s in stances(rng)} == {-40, 0, 60}


def test_rotations_stay_below_the_largest(rng: np.random.Generator) -> None:
    drawn = draw_stances(rng, [0.0], [2.0], 500, 0.3, (1.0, 1.0))
    angles = np.linalg.norm(so3.log(np.stack([s.R_facing_board for s in drawn])), axis=1)
    assert 0.35 < angles.max() <= 0.3 * np.sqrt(3) * 1.05


def test_board_is_absent_during_the_background_window(rng: np.random.Generator) -> None:
    assert timeline(rng).stance(4.99) is None


def test_board_rests_through_every_hold(rng: np.random.Generator) -> None:
    walk = timeline(rng)
    for hold in walk.holds:
        times = np.linspace(hold.start, hold.end, 20)
        assert all(walk.stance(float(t)) is hold.stance for t in times[:-1])
        assert walk.still(hold.start, hold.end)


def test_board_moves_between_holds(rng: np.random.Generator) -> None:
    walk = timeline(rng)
    assert not any(walk.still(a.end - 0.1, a.end + 0.1) for a in walk.holds[:-1])


def test_moves_start_and_end_smoothly(rng: np.random.Generator) -> None:
    walk = timeline(rng)
    end = walk.holds[3].end
    positions = []
    for t in (end, end + 0.01, end + 0.4, end + 0.41):
        stance = walk.stance(t)
        assert stance is not None
        positions.append(board_pose(stance)[:3, 3])
    first, fastest = (float(np.linalg.norm(positions[i + 1] - positions[i])) for i in (0, 2))
    assert first < 0.01 * fastest


def test_disturbed_hold_shows_two_poses_as_far_apart_as_stated(rng: np.random.Generator) -> None:
    walk = timeline(rng, disturbed=1)
    hold = walk.holds[0]
    before, after = walk.stance(hold.start + 0.5), walk.stance(hold.end - 0.3)
    assert before is not None
    assert after is not None
    step = board_pose(after)[:3, 3] - board_pose(before)[:3, 3]
    assert np.linalg.norm(step) == pytest.approx(0.06, rel=0.02)
    assert not walk.still(hold.start, hold.end)


def test_walk_between_opposite_bearings_goes_around_the_robot() -> None:
    ends = [Stance(np.radians(b), 2.0, 1.0, np.eye(3)) for b in (-90, 90)]
    walk = schedule(ends, background=1.0, move_time=1.0, hold_end=lambda start: start + 1, disturbed=[None, None])
    for t in np.linspace(walk.holds[0].end, walk.holds[1].start, 30, endpoint=False):
        stance = walk.stance(float(t))
        assert stance is not None
        assert np.hypot(*board_pose(stance)[:2, 3]) == pytest.approx(2.0)
