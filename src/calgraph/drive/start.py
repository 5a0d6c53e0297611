"""Start values without a guess: clocks by turn rates, poses by relative motions (hand-eye calibration).

They are of each sensor against the one that leads, whose trajectory covers most of the time.

Sources: Tsai and Lenz, "A new technique for fully autonomous and efficient 3D robotics hand/eye calibration",
1989; Brookshire and Teller, "Automatic calibration of multiple coplanar sensors", 2011, for motion in the plane.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calgraph.drive.segments import Segments
from calgraph.errors import Rejected
from calgraph.geometry import STDDEV_PER_MAD, Array, plane, se2, se3, se_n
from calgraph.solver.lagged_correlation import correlate_at_lags

# Rate at which turn rates are compared, Hz: above that of sweeps; a parabola refines steps of 20 ms.
_RATE = 50.0
# Share of the common time in which the turn rates of both are known, for a correlation to count.
_MIN_KNOWN = 0.1
# The same of the shorter one, for offsets of clocks of which nothing is known: of a hundred times as many offsets,
# one agrees by chance.
_MIN_COMMON = 0.5
# Relative motions are over this time, s: long against the noise of a sweep, short against the drift of odometry.
MOTION_DURATION = 1.5
# And start this far apart, s: half of the duration, so that errors of neighbours are hardly independent.
_MOTION_STEP = 0.5
# Durations of motions in the frame of a board, s: they do not drift, and turns between far views are larger.
_BOARD_DURATIONS = (0.75, MOTION_DURATION, 3.0, 6.0, 12.0)
# Motions with which the random samples of three have a meaning, and how many of them have to agree: six of 11
# agreed with a pose 6.6 m off, as samples at 22 clock offsets find some that do; 7 of 10 and more with right ones.
_MIN_MOTIONS, _MIN_AGREEING = 10, 7
# Poses by boards are this many times as precise as those of odometry that counts as right.
_BOARD_PRECISION = 3.0
# Offsets of clocks around one by turn rates that are compared, s: 50 ms are a degree or two of a turn.
_CLOCK_STEPS = (np.linspace(-0.3, 0.3, 13), np.linspace(-0.04, 0.04, 9))
# Random samples: with half of the motions wrong, 200 of three have a right one with 1 - (7/8)^200.
_SAMPLES = 200
# Errors of a relative motion beyond which it counts as wrong, m and rad: odometry in the plane of offices.
_MAX_ERROR = 0.15, 0.05
# Correlation of turn rates below which a clock offset is chance: that of the best of 60 offsets of independent
# drives is up to 0.5.
_MIN_CORRELATION = 0.6
# RMS turns of motions that determine a pose, rad: ten times the error of odometry's rotation, 0.2 degrees, about
# the main axis; about a second axis five times. Turns have to change by as much: a clock is found by these. They
# change by 0.001 to 0.01 where a robot drives a circle, and up to 0.022 where it drives straight on.
_MIN_TURN, MIN_SECOND_TURN = 0.035, 0.0175
# Travel of motions in the plane that determines where a sensor looks, m: more than the largest error of one. It is
# 0.01 to 0.07 of robots that turn on the spot, or drive a circle, and 0.46 and more of others.
_MIN_TRAVEL = 0.2
# Share of motions that has to agree: with fewer, another pose may have as many.
_MIN_INLIERS = 0.3


@dataclass(frozen=True, eq=False)
class MotionStart:
    """The start pose and clock of a sensor, from its motion and the root's."""

    T_root_sensor: Array
    """(n+1, n+1)."""
    clock_offset: float
    """The sensor's clock minus the root's, s."""
    inliers: float
    """Share of the motions that agree."""
    correlation: float
    """Of the turn rates, at the clock offset."""
    motions: int
    """Number of relative motions."""
    turns: Array
    """(d,) RMS turn of the sensor during a motion, about the principal axes of turning, rad, descending."""
    turn_change: float = np.inf
    """Standard deviation of the turns about the main axis, rad: the larger of the sensor's and the root's."""
    travel: float = np.inf
    """RMS of the part of motions in the plane that turns about one fixed point do not explain, m; infinite in
    space, where turns about two axes determine the rotation."""
    axis: Array | None = None
    """(3,) about which alone the root turned, in its frame, where the pose is at no height along it."""
    by_boards: bool = False
    """Whether the clock is that of motions before boards, which turn rates show poorly."""
    open_height: bool = False
    """Whether it has no height along ``axis`` from a floor or ceiling that both measured."""

    def relative_to(self, other: "MotionStart") -> "MotionStart":
        """The start against another sensor, from those of both against the root."""
        T = se_n.inverse(other.T_root_sensor) @ self.T_root_sensor
        return replace(
            self,
            T_root_sensor=T,
            clock_offset=self.clock_offset - other.clock_offset,
            correlation=min(self.correlation, other.correlation),
            open_height=self.open_height or other.open_height,
        )


StartMotion = Literal["free", "level", "turn"]
"""What two trajectories determine; see :func:`solve_start`."""


def find_clock_offset(root: Segments, sensor: Segments, max_offset: float) -> tuple[float, float]:
    """The offset of the sensor's clock, s, at which turn rates agree best, and Pearson's coefficient there.

    Args:
        root: trajectory of the root.
        sensor: of the sensor.
        max_offset: to search within, s; where they have no time in common then, at all offsets at which they have
            half of the shorter one.
    """
    (own, own_known), (rates, known) = (
        one.turn_rates(np.arange(one.start, one.end, 1 / _RATE)) for one in (root, sensor)
    )
    for overlap, largest in ((_MIN_KNOWN, max_offset), (_MIN_COMMON, np.inf)):
        lags, scores = correlate_at_lags(rates, own, overlap, known, own_known)
        offsets = sensor.start - root.start + lags / _RATE
        scores, offsets = (one[np.abs(offsets) <= largest] for one in (scores, offsets))
        if len(scores):
            break
    best = int(np.argmax(scores))
    shift = 0.0
    if 0 < best < len(scores) - 1:
        before, at, after = scores[best - 1 : best + 2]
        shift = 0.5 * float(before - after) / min(float(before - 2 * at + after), -1e-12)
    return float(offsets[best] + shift / _RATE), float(scores[best])


def solve_start(
    root: Segments, sensor: Segments, max_offset: float, rng: np.random.Generator, motion: StartMotion = "free"
) -> MotionStart | Rejected:
    """The pose and the clock of a sensor from two trajectories.

    Args:
        root: trajectory of the root, in its world.
        sensor: of the sensor, in another world.
        max_offset: largest difference of the clocks, s.
        rng: for random samples.
        motion: what the trajectories determine in space: ``free``, or ``level`` where either of them may have
            turned about one axis only, along which no position is found, or ``turn`` where the sensor has no
            positions.
    """
    offset, correlation = find_clock_offset(root, sensor, max_offset)
    boards = bool(root.worlds or sensor.worlds)
    if boards:
        offset = _search_clock(root, sensor, offset, max_offset, rng)
    A, B = _pair_motions(root, sensor, offset)
    if len(A) < _MIN_MOTIONS:
        return Rejected(f"it and the root moved together {len(A)} times only, {_MIN_MOTIONS} are needed")
    turns, axis, travel = measure_turns(B)[0], None, np.inf
    if motion == "turn":
        T, weights = _solve_rotation(A, B)
    elif motion == "level" and min(measure_turns(A)[0][1], turns[1]) < MIN_SECOND_TURN:
        axis = measure_turns(A)[1][0]
        T, weights, travel = _solve_level(A, B, rng)
    else:
        T, weights = _solve_pose(A, B, rng)
        if A.shape[-1] == 3:
            travel = _measure_travel(T, A, B, weights)
    inliers = float(np.mean(weights > 0.25))
    change = max(float(np.std(se_n.log(se_n.rotation(one)) @ measure_turns(one)[1][0])) for one in (A, B))
    return MotionStart(T, offset, inliers, correlation, len(A), turns, change, travel, axis, boards)


def _pair_motions(root: Segments, sensor: Segments, offset: float) -> tuple[Array, Array]:
    """Motions (K, n+1, n+1) of the root and of the sensor during the same times, by a clock offset."""
    first = max(root.start, sensor.start - offset)
    last = min(root.end, sensor.end - offset) - MOTION_DURATION
    starts = np.arange(first, last, _MOTION_STEP)
    motions = []
    for duration in _BOARD_DURATIONS if root.worlds or sensor.worlds else (MOTION_DURATION,):
        A, root_known = root.relative(starts, duration)
        B, sensor_known = sensor.relative(starts + offset, duration)
        both = root_known & sensor_known
        motions.append((A[both], B[both]))
    A, B = (np.concatenate(some) for some in zip(*motions, strict=True))
    return A, B


def _search_clock(
    root: Segments, sensor: Segments, offset: float, max_offset: float, rng: np.random.Generator
) -> float:
    """The clock offset near one by turn rates at which motions agree best, s.

    Boards are in view for seconds only, and images are rarer than turns: correlation is wrong by up to 0.2 s.
    """
    for steps in _CLOCK_STEPS:
        found = []
        for candidate in np.clip(offset + steps, -max_offset, max_offset):
            A, B = _pair_motions(root, sensor, candidate)
            if len(A) >= _MIN_MOTIONS:
                cost = _truncated(_errors(_solve_pose(A, B, rng)[0], A, B) * _BOARD_PRECISION)
                found.append((float(np.mean(cost)), float(candidate)))
        offset = min(found)[1] if found else offset
    return offset


def measure_turns(motions: Array) -> tuple[Array, Array]:
    """RMS turns (d,) of motions about the principal axes of turning, rad, descending; and these axes (d, d)."""
    vectors = se_n.log(se_n.rotation(motions))
    _, turns, axes = np.linalg.svd(vectors, full_matrices=False)
    return np.asarray(turns / np.sqrt(len(motions))), np.asarray(axes)


def explain_failure(start: MotionStart, name: str, motion: StartMotion = "free") -> str:
    """Why a start is not to be relied on, and what to drive instead; empty if it is."""
    if start.turn_change < _MIN_TURN and not start.by_boards:
        return (
            f"the robot turned at a constant rate (± {np.degrees(start.turn_change):.1f}° in "
            f"{MOTION_DURATION:g} s): drive curves to both sides, without which nothing determines where {name} is"
        )
    if start.correlation < _MIN_CORRELATION and not start.by_boards:
        return (
            f"its turn rates do not agree with the root's (correlation {start.correlation:.2f}): its clock is "
            "half a second off or more, or its odometry failed; drive slower, where walls and furniture are near"
        )
    if start.turns[0] < _MIN_TURN:
        return (
            f"the robot hardly turned ({np.degrees(start.turns[0]):.1f}° in {MOTION_DURATION:g} s): drive curves, "
            f"without which nothing determines where {name} is"
        )
    if motion == "free" and len(start.turns) == 3 and start.turns[1] < MIN_SECOND_TURN:
        return (
            f"the robot turned about one axis only ({np.degrees(start.turns[1]):.1f}° about others in "
            f"{MOTION_DURATION:g} s), which leaves the height of {name} and a rotation open: drive over ramps, too"
        )
    if start.travel < _MIN_TRAVEL:
        return (
            f"the robot turned about one point only (other motion is {start.travel:.2f} m in "
            f"{MOTION_DURATION:g} s), which leaves open to which side of it {name} is and how it is turned: "
            "drive curves in both directions"
        )
    if (agreeing := round(start.inliers * start.motions)) < _MIN_AGREEING:
        return (
            f"only {agreeing} of its {start.motions} motions together with the root agree with one pose, "
            f"{_MIN_AGREEING} are needed: drive longer, with more turns where it measures"
        )
    if start.inliers < _MIN_INLIERS:
        return (
            f"only {start.inliers:.0%} of its motions agree with a pose on the root's robot: its odometry failed, "
            "or it is not fixed; drive slower, where walls and furniture are near"
        )
    return ""


def _solve_pose(A: Array, B: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """The pose (n+1, n+1) of motions A (K, n+1, n+1) and B, and weights (K,) of these, 1 if they agree."""
    return _refine(_sample_poses(A, B, rng), A, B)


def _sample_poses(A: Array, B: Array, rng: np.random.Generator) -> Array:
    """The pose (n+1, n+1) with which most motions agree, of random samples of three."""
    chosen = np.array([rng.choice(len(A), 3, replace=False) for _ in range(_SAMPLES)])
    find_rotations = _rotate_in_plane if A.shape[-1] == 3 else _rotate_in_space
    R = find_rotations(A[chosen], B[chosen])
    T = se_n.pose(R, _solve_translation(A[chosen], B[chosen], R))
    cost = np.array([_truncated(_errors(one, A, B)).sum() for one in T])
    return np.asarray(T[np.argmin(cost)])


def _errors(T: Array, A: Array, B: Array) -> Array:
    """(K, n+d) of ``A T`` against ``T B``, m and rad, in the largest ones of a right motion."""
    errors = se_n.difference(A @ T, T @ B)
    return np.asarray(errors / _scale(len(T) - 1))


def _scale(n: int) -> Array:
    """(n+d,) the largest error of a right motion, m and rad."""
    return np.repeat(_MAX_ERROR, [n, n * (n - 1) // 2])


def _truncated(errors: Array) -> Array:
    """(K,) squared errors (K, n+d), at most 1."""
    return np.asarray(np.minimum(np.sum(errors**2, axis=1), 1.0))


def _rotate_in_plane(A: Array, B: Array) -> Array:
    """Rotations (S, 2, 2) of samples (S, m, 3, 3): ``[R_A - I, -J(t_B)] (t_x, t_y, cos θ, sin θ) = -t_A``."""
    x, y = B[..., 0, 2], B[..., 1, 2]
    left = A[..., :2, :2] - np.eye(2)
    right = -np.stack([np.stack([x, -y], axis=-1), np.stack([y, x], axis=-1)], axis=-2)
    solution = _solve_least_squares(np.concatenate([left, right], axis=-1), -A[..., :2, 2])
    return se_n.exp(np.arctan2(solution[:, 3], solution[:, 2])[:, None])


def _rotate_in_space(A: Array, B: Array) -> Array:
    """Rotations (S, 3, 3) of samples (S, m, 4, 4): rotation vectors are turned, ``a = R b`` (Kabsch)."""
    a, b = se_n.log(se_n.rotation(A)), se_n.log(se_n.rotation(B))
    return se_n.nearest_rotation(np.swapaxes(a, -1, -2) @ b)


def _solve_translation(A: Array, B: Array, R: Array) -> Array:
    """(S, n) of ``(R_A - I) t = R t_B - t_A``."""
    n = A.shape[-1] - 1
    turned = np.einsum("sij,smj->smi", R, se_n.translation(B))
    return _solve_least_squares(se_n.rotation(A) - np.eye(n), turned - se_n.translation(A))


def _solve_least_squares(M: Array, b: Array) -> Array:
    """(S, p) of problems (S, m, n, p) and (S, m, n); directions that nothing determines stay near 0."""
    M, b = M.reshape(len(M), -1, M.shape[-1]), b.reshape(len(b), -1, 1)
    # A turn by 0.01 rad determines a position no better than the largest error of a motion.
    H = np.swapaxes(M, -1, -2) @ M + 1e-4 * np.eye(M.shape[-1])
    return np.asarray(np.linalg.solve(H, np.swapaxes(M, -1, -2) @ b)[..., 0])


def _refine(T: Array, A: Array, B: Array) -> tuple[Array, Array]:
    """The pose of least robust squared errors, and the weights of motions (K,)."""
    n = T.shape[-1] - 1
    for step in range(20):
        e = _errors(T, A, B)
        # The scale falls to that of the errors, which is far below the largest one where odometry is good.
        spread = (
            np.maximum(STDDEV_PER_MAD * np.median(np.abs(e), axis=0), 0.02) if step > 5 else np.ones(e.shape[1])
        )
        e = e / spread
        weights = (1 + np.sum(e**2, axis=1) / 9) ** -2.0
        J = _jacobian(T, A, B) / (_scale(n) * spread)[:, None]
        H = np.einsum("k,kij,kil->jl", weights, J, J)
        g = np.einsum("k,kij,ki->j", weights, J, e)
        T = se_n.retract(T, -np.linalg.solve(H + 1e-9 * np.eye(len(H)), g))
    return T, weights


def _jacobian(T: Array, A: Array, B: Array) -> Array:
    """(K, n+d, n+d) derivatives of ``A T`` against ``T B`` by the pose, for small errors of the rotation."""
    n = T.shape[-1] - 1
    J = se_n.rotation_adjoint(se_n.rotation(A)) - np.eye(n * (n + 1) // 2)
    J[:, :n, n:] = -se_n.rotation_jacobian(B[:, :n, n] @ T[:n, :n].T)
    return J


def _measure_travel(T: Array, A: Array, B: Array, weights: Array) -> float:
    """:attr:`MotionStart.travel` of motions (K, 3, 3) with a pose of the sensor and weights (K,)."""
    J = _jacobian(T, A, B)[:, :2]
    H = np.einsum("k,kij,kil->jl", weights, J, J) + 1e-9 * np.eye(3)
    left = H[2, 2] - H[2, :2] @ np.linalg.solve(H[:2, :2], H[:2, 2])
    return float(np.sqrt(max(left, 0.0) / max(weights.sum(), 1e-9)))


def _solve_level(A: Array, B: Array, rng: np.random.Generator) -> tuple[Array, Array, float]:
    """As :func:`_solve_pose`, of motions about one axis: in the plane across it, at no height along it.

    The last is :attr:`MotionStart.travel`.
    """
    up_A, up_B = (measure_turns(one)[1][0] for one in (A, B))
    turns_A, turns_B = (se_n.log(se_n.rotation(one)) @ up for one, up in ((A, up_A), (B, up_B)))
    up_B = up_B * np.sign(turns_A @ turns_B)
    to_A, to_B = (se3.pose(np.column_stack([plane.tangent_basis(up), up]), np.zeros(3)) for up in (up_A, up_B))
    A, B = _flatten(to_A.T @ A @ to_A), _flatten(to_B.T @ B @ to_B)
    T, weights = _solve_pose(A, B, rng)
    return to_A @ se2.to_se3(T) @ to_B.T, weights, _measure_travel(T, A, B, weights)


def _flatten(motions: Array) -> Array:
    """Motions (K, 3, 3) in the plane across z, from those in space (K, 4, 4)."""
    turn = se_n.log(se_n.rotation(motions))
    return se_n.pose(se_n.exp(turn[:, 2:]), se_n.translation(motions)[:, :2])


def _solve_rotation(A: Array, B: Array) -> tuple[Array, Array]:
    """As :func:`_solve_pose`, of turns alone, which have a constant bias: ``a = R (b - b̄) + ā``."""
    a, b = se_n.log(se_n.rotation(A)), se_n.log(se_n.rotation(B))
    weights, R = np.ones(len(a)), np.eye(3)
    for _ in range(20):
        from_a, from_b = (one - weights @ one / weights.sum() for one in (a, b))
        R = se_n.nearest_rotation(from_a.T @ (from_b * weights[:, None]))
        size = np.linalg.norm(from_a - from_b @ R.T, axis=1)
        weights = (1 + (size / (3 * max(float(np.median(size)), 1e-4))) ** 2) ** -2.0
    return se_n.pose(R, np.zeros(3)), weights


# Share of the time that the best trajectory covers, with which the root's is taken: LiDARs start at other times.
_MIN_COVERAGE = 0.8
# Largest difference of clocks that is searched for, s.
_MAX_CLOCK_OFFSET = 0.6


def choose_lead(root: str, tracks: Mapping[str, Segments | Rejected]) -> str:
    """The sensor whose trajectory covers most of the time; the root, if it covers nearly as much."""
    covered = {name: 0.0 if isinstance(track, Rejected) else track.covered for name, track in tracks.items()}
    best = max(covered, key=lambda name: covered[name])
    return root if root in covered and covered[root] >= _MIN_COVERAGE * covered[best] else best


def solve_starts(
    lead: str, tracks: Mapping[str, Segments | Rejected], motions: Mapping[str, StartMotion], seed: int
) -> dict[str, MotionStart | Rejected]:
    """The start pose and clock of each sensor but the one that leads, against it, or why it has none.

    Cameras before boards cover little of the time. Where all sensors do, those that are connected serve the next
    ones together: they have poses in the frames of the same boards.

    Args:
        lead: name of the sensor that leads.
        tracks: trajectory by sensor, or why it has none.
        motions: what each start is found from.
        seed: of random samples.
    """
    along = tracks[lead]
    if isinstance(along, Rejected):
        reason = f"the root {lead} has no trajectory: {along.reason}"
        return {
            name: track if isinstance(track, Rejected) else Rejected(reason)
            for name, track in tracks.items()
            if name != lead
        }
    found: dict[str, MotionStart | Rejected] = {}
    pending = [name for name in tracks if name != lead]
    rngs = {name: np.random.default_rng([seed, k, 2]) for k, name in enumerate(tracks)}
    while pending:
        tried = {name: _solve_start(along, name, tracks[name], motions[name], rngs[name]) for name in pending}
        found |= tried
        solved = {
            name: (start, track)
            for name, start in tried.items()
            if isinstance(start, MotionStart) and isinstance(track := tracks[name], Segments) and track.worlds
        }
        if not along.worlds or not solved:
            break
        # Of cameras, the one that moved most together with those that are connected is the next.
        best = max(solved, key=lambda name: solved[name][0].motions)
        start, track = solved[best]
        along = along.joined(track.of_frame(se_n.inverse(start.T_root_sensor), -start.clock_offset))
        pending.remove(best)
    return found


def _solve_start(
    along: Segments, name: str, track: Segments | Rejected, motion: StartMotion, rng: np.random.Generator
) -> MotionStart | Rejected:
    """The start pose and clock of a sensor against a trajectory, or why it has none."""
    if isinstance(track, Rejected):
        return track
    start = solve_start(along, track, _MAX_CLOCK_OFFSET, rng, motion)
    if isinstance(start, Rejected):
        return start
    failure = explain_failure(start, name, motion)
    return Rejected(failure) if failure else start
