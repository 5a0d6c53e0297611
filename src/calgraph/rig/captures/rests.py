"""Rests of the board, by a joint decision of all sensors.

A hidden Markov model has two states, rest and motion, and the activities of all sensors as its output. Their
distributions in both states are learned from the recording: where a sensor does not see the board move, they are
the same, and its likelihood ratio decides nothing. States and distributions are found in turn (Juang and Rabiner
1990, The segmental K-means algorithm), from several starts; the states with most information on the
activities are taken.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from calgraph.config.settings import CaptureSettings
from calgraph.errors import CalibrationError
from calgraph.geometry import Array
from calgraph.rig.captures.motion_detection import JITTER, MIN_ACTIVITY
from calgraph.rig.captures.timeline import MAX_MOTION_PERIOD, RecordingTimeline, SensorTimes

# Length of the cells of time that have one state each, s: no sensor but fast scanners resolves less.
_CELL = 0.05
# Longest recording that is searched, s: a clock that is set a year ahead would take gigabytes of cells.
_MAX_DURATION = 100_000.0
# Bounds of the bins (base 10) in which activities are counted; noise of a view scatters by one bin.
_BINS = np.arange(-3.75, 0.01, 0.25)
# Messages that a distribution starts from, which are spread as those of both states together: a few of one state
# show little.
_PRIOR_MESSAGES = 20.0
# Bounds of a message's vote: a board may be out of a view while it moves, and people behind it move while it
# rests.
_MIN_VOTE, _MAX_VOTE = -1.5, 3.0
# Messages nearer than this in time, s, share one vote: what moves behind the board is in all of them.
_INDEPENDENT = 0.1
# Where half of a view changes it moves, also if it does so all the time: noise of no sensor does.
_CERTAIN_ACTIVITY = 0.5
# Logarithm of the odds against a change of state from cell to cell: short rests and moves last 1 s, 20 cells.
_CHANGE_COST = 3.0
# Shares of a sensor's messages that start as motion: those of operators who move shortly, or rest shortly. At the
# start, each message decides.
_STARTS = (0.4, 0.7)
# Share of the information by which that of equal states differs: to take trembling near a camera for motion
# exceeded the right states by a fiftieth.
_EQUAL = 0.05
# Each start settles in two to six steps.
_MAX_STEPS = 12
# Share of the messages in the middle half of rests whose activity is noise: others show people behind the board.
_NOISE_SHARE = 0.9
_MIDDLE = 0.25


@dataclass(frozen=True, eq=False)
class _Votes:
    """Where the messages of one sensor vote, and with what activity."""

    starts: Array
    """(N,) s; from here to ``ends`` the message shows whether something moved."""
    ends: Array
    """(N,) s."""
    activity: Array
    """(N,) 0..1."""
    bins: NDArray[np.intp]
    """(N,) of the activity."""
    first: NDArray[np.intp]
    """(N,) first cell for which the message votes,"""
    stop: NDArray[np.intp]
    """and the first one after them."""
    weight: float
    """Of its votes, at most 1."""

    def share_in_motion(self, moving: NDArray[np.bool_]) -> Array:
        """(N,) share of the cells of each message that move."""
        count = np.concatenate([[0], np.cumsum(moving)])
        return np.asarray((count[self.stop] - count[self.first]) / (self.stop - self.first))

    def sum_over_cells(self, votes: Array, cells: int) -> Array:
        """(cells,) the sum of votes (N,), each divided among the cells it is for."""
        steps = np.zeros(cells + 1)
        each = self.weight * votes / (self.stop - self.first)
        np.add.at(steps, self.first, each)
        np.add.at(steps, self.stop, -each)
        return np.cumsum(steps)[:-1]

    def count(self, moving: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Numbers of messages by bin, in rest and in motion."""
        share = self.share_in_motion(moving)
        bins = len(_BINS) + 1
        rest, motion = np.bincount(self.bins, 1 - share, bins), np.bincount(self.bins, share, bins)
        return rest.astype(np.float64), motion.astype(np.float64)


def find_rests(timeline: RecordingTimeline, settings: CaptureSettings) -> list[tuple[float, float]]:
    """Where the board rests for as long as the slowest sensor needs for one full measurement.

    Returns:
        Start and end of each rest, s, in order of time.

    Raises:
        CalibrationError: stamps are days apart.
    """
    found = {name: one.with_content() for name, one in timeline.sensors.items()}
    names = [
        name
        for name, times in found.items()
        if times.period <= MAX_MOTION_PERIOD and len(times.stamps) > 2 and np.ptp(times.stamps) > 0
    ]
    if not names:
        return []
    fast = [found[name] for name in names]
    start = min(float(times.stamps[0]) for times in fast)
    ends = [float(times.stamps[-1]) + times.duration for times in fast]
    duration = max(ends) - start
    if duration > _MAX_DURATION:
        first = names[int(np.argmin([times.stamps[0] for times in fast]))]
        raise CalibrationError(
            f"{names[int(np.argmax(ends))]}: its last stamp is {duration / 86400:.1f} days after the first one of "
            f"{first}, too long for a search of the board's rests: correct or remove the messages that are wrong"
        )
    cells = int(np.ceil(duration / _CELL)) + 1
    # A message compares with one up to a baseline before: its activity shows motion in all that time.
    baseline = max(times.baseline for times in fast)
    sensors = [_make_votes(times, start, cells, baseline) for times in fast]
    states = _decide(sensors, cells, settings.min_poses)
    spans = [(start + _CELL * a - baseline, start + _CELL * b) for a, b in _list_spans(~states)]
    periods = [times.period for times in timeline.sensors.values() if np.isfinite(times.period)]
    shortest = max(settings.min_hold, *periods)
    return [(a, b) for a, b in _trim(spans, sensors) if b - a >= shortest]


def find_noise(timeline: RecordingTimeline, rests: Sequence[tuple[float, float]]) -> dict[str, float]:
    """By sensor with messages in the rests, the median of their activities there."""
    found = {}
    for name, times in ((name, one.with_content()) for name, one in timeline.sensors.items()):
        since = times.stamps - times.reach
        inside = np.any([(since >= a) & (times.stamps <= b) for a, b in rests], axis=0)
        if inside.any():
            found[name] = float(np.median(times.activity[inside]))
    return found


def _make_votes(times: SensorTimes, start: float, cells: int, baseline: float) -> _Votes:
    stamps = times.stamps
    before = np.arange(len(stamps) - 1)
    compared = np.minimum(np.searchsorted(stamps, stamps[1:] - times.baseline - JITTER), before)
    starts, ends = stamps[compared], stamps[1:] + times.duration
    shown = np.minimum(starts + baseline, ends - min(times.period, baseline or times.period))
    first = np.clip(np.round((shown - start) / _CELL).astype(np.intp), 0, cells - 1)
    stop = np.maximum(np.minimum(np.round((ends - start) / _CELL).astype(np.intp), cells), first + 1)
    activity = times.activity[1:]
    bins = np.searchsorted(_BINS, np.log10(np.maximum(activity, MIN_ACTIVITY)))
    return _Votes(starts, ends, activity, bins, first, stop, min(times.period / _INDEPENDENT, 1.0))


@dataclass(frozen=True, eq=False)
class _States:
    """Where something moves, as found from one start."""

    moving: NDArray[np.bool_]
    """(cells,)."""
    rests: int
    """Their number."""
    information: float
    """On the activities, nats."""


def _decide(sensors: Sequence[_Votes], cells: int, min_rests: int) -> NDArray[np.bool_]:
    """(cells,) whether something moves: of several states with most information, the one with most rests."""
    found: list[_States] = []
    for sensor in sensors:
        for share in _STARTS:
            above = sensor.activity > np.quantile(sensor.activity, 1 - share)
            moving = _find_states(_CHANGE_COST * sensor.sum_over_cells(np.where(above, 1.0, -1.0), cells))
            for _ in range(_MAX_STEPS):
                before, votes = moving, [_vote(each, moving) for each in sensors]
                moving = _find_states(
                    np.sum([one.sum_over_cells(v, cells) for one, v in zip(sensors, votes, strict=True)], axis=0)
                )
                if np.array_equal(moving, before):
                    break
            information = sum(one.weight * _measure_information(*one.count(moving)) for one in sensors)
            information -= _CHANGE_COST * np.count_nonzero(np.diff(moving))
            found.append(_States(moving, len(_list_spans(~moving)), information))
    # A person who enters the room changes views as well, but once.
    found = [one for one in found if one.rests >= min_rests] or found
    most = max(one.information for one in found)
    near = [one for one in found if one.information >= most - _EQUAL * abs(most)]
    return max(near, key=lambda one: (one.rests, one.information)).moving


def _vote(sensor: _Votes, moving: NDArray[np.bool_]) -> Array:
    """(N,) logarithm of each message's likelihood ratio of motion to rest, which does not fall with activity."""
    rest, motion = sensor.count(moving)
    both = rest + motion
    # One message of another kind in ten keeps an activity that was never measured from deciding alone.
    prior = _PRIOR_MESSAGES * (0.9 * both / both.sum() + 0.1 / len(both))
    ratio = np.log((motion + prior) / (motion.sum() + _PRIOR_MESSAGES))
    ratio -= np.log((rest + prior) / (rest.sum() + _PRIOR_MESSAGES))
    ratio = np.clip(isotonic_regression(ratio, weights=both + prior).x, _MIN_VOTE, _MAX_VOTE)
    return np.where(sensor.activity >= _CERTAIN_ACTIVITY, _MAX_VOTE, ratio[sensor.bins])


def _find_states(votes: Array) -> NDArray[np.bool_]:
    """(cells,) whether each moves, by the sum of the votes of each: the most likely path (Viterbi 1967)."""
    rest = motion = 0.0
    rest_came_from_motion, motion_came_from_rest = [], []
    for vote in votes.tolist():
        rest_came_from_motion.append(motion - _CHANGE_COST > rest)
        motion_came_from_rest.append(rest - _CHANGE_COST > motion)
        rest, motion = max(rest, motion - _CHANGE_COST), max(motion, rest - _CHANGE_COST) + vote
    moves = motion > rest
    states = np.zeros(len(votes), bool)
    for k in range(len(votes) - 1, -1, -1):
        states[k] = moves
        moves ^= motion_came_from_rest[k] if moves else rest_came_from_motion[k]
    return states


# Least information of a message in motion, nats: a sensor that does not see a move measures rest in all the ten
# messages of it, which are one piece of evidence.
_MIN_INFORMATION = -0.1


def _measure_information(rest: Array, motion: Array) -> float:
    """Mutual information of state and bin, nats, times the number of messages (Cover and Thomas, 2.3).

    What a message in motion contributes is bounded.
    """
    share = (rest + motion) / (rest + motion).sum()

    def sum_terms(counts: Array, least: float) -> float:
        some = counts > 0
        terms = np.log(counts[some] / counts.sum() / share[some])
        return float(counts[some] @ np.maximum(terms, least))

    return sum_terms(rest, -np.inf) + sum_terms(motion, _MIN_INFORMATION)


def _list_spans(states: NDArray[np.bool_]) -> list[list[int]]:
    """First cell of each run of true ones, and the first one after it."""
    spans: list[list[int]] = np.flatnonzero(np.diff(np.r_[False, states, False])).reshape(-1, 2).tolist()
    return spans


def _trim(spans: Sequence[tuple[float, float]], sensors: Sequence[_Votes]) -> list[tuple[float, float]]:
    """The rests without the messages at their ends in which more changed than noise.

    Without this they reach into the slow start and end of moves, at which boards drift by centimetres.
    """
    rests = np.array(spans).reshape(-1, 2)
    trimmed = rests.copy()
    for sensor in sensors:
        inside = [(sensor.starts >= a - JITTER) & (sensor.ends <= b + JITTER) for a, b in rests]
        middle = [
            one & (sensor.ends >= a + _MIDDLE * (b - a)) & (sensor.starts <= b - _MIDDLE * (b - a))
            for one, (a, b) in zip(inside, rests, strict=True)
        ]
        of_noise = sensor.activity[np.any(middle, axis=0)] if middle else np.zeros(0)
        if not len(of_noise):
            continue
        still = sensor.activity <= np.quantile(of_noise, _NOISE_SHARE)
        for k, one in enumerate(inside):
            quiet = np.flatnonzero(one & still)
            if len(quiet):
                trimmed[k, 0] = max(trimmed[k, 0], sensor.starts[quiet[0]])
                trimmed[k, 1] = min(trimmed[k, 1], sensor.ends[quiet[-1]])
    return [(float(a), float(b)) for a, b in trimmed]
