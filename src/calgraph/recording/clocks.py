"""The clocks of a recording's topics, by the times at which their messages arrived.

A recorder notes by its own clock when each message arrives, some hundredths of a second after the measurement. So
the arrivals compare the clocks that the stamps are of: one that counts from power-up, TAI or GPS time, or the time
of another zone shows as a constant difference. It is known as well as the delays are, to a tenth of a second.
"""

from array import array
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.errors import RecordingError
from calgraph.geometry import Array, estimate_spread
from calgraph.recording.cache import NO_CACHE, RecordingCache
from calgraph.recording.recording import JoinedRecording, Recording
from calgraph.sensors import LaserScan, Message, PointCloud

# Standard deviation of an offset from arrivals, s: drivers and networks take between some milliseconds and some
# tenths of a second.
_DELAY_STDDEV = 0.1
# Longest time, s, that messages are on their way: queues of drivers and of wireless links hold some seconds of
# data. A larger difference is one of clocks; the smallest of those that have a name, GPS against UTC, is 18 s.
_MAX_DELAY = 10.0
# Stamps that are ahead of the arrival by more than this, s, were not made by the recorder's clock: NTP sets clocks
# to some ten milliseconds, and drivers that predict the middle of an exposure are ahead by less.
_MAX_LEAD = 0.2
# Minimum difference, s, that may be one of clocks, where other evidence confirms it: usual delays are shorter.
_MIN_SUSPECT = 0.4
# Period of sensors, s, above which a message is a slow sweep: its stamp may be as old as the sweep is long.
_MAX_PERIOD = 0.5
# Share of messages that arrive sooner than the delay that counts: the shortest delay is the most constant part of
# it, also where messages arrive in bursts, and single wrong stamps do not matter.
_QUICKEST = 0.05
# Differences of time scales, s. That of GPS and UTC is that since 2017; no leap second was announced since.
_TIME_SCALES = {37.0: "TAI against UTC", 18.0: "GPS time against UTC", 19.0: "TAI against GPS time"}
# Zones differ by multiples of a quarter of an hour, and by 14 h at most from UTC.
_ZONE_STEP, _MAX_ZONE = 900.0, 26 * 3600.0
# Distance to such a difference, s, within which an offset is taken for it: three standard deviations.
_MAX_NAME_DISTANCE = 3 * _DELAY_STDDEV
# Earliest stamp of a clock that was set, s since 1970: the year 1980. Clocks without a battery begin at 0.
_FIRST_DATE = 10 * 365.25 * 86400.0
_FORMAT = "arrivals/2"


@dataclass(frozen=True, eq=False)
class Arrivals:
    """When the messages of a topic were stamped, and when they arrived."""

    stamps: Array
    """(N,) s."""
    arrivals: Array
    """(N,) of the same messages, s by the recorder's clock."""
    duration: float = 0.0
    """Time from the stamp to the end of the measurement, s."""

    @property
    def are_stamps(self) -> bool:
        """Whether the arrivals are the stamps: headers have none, or another program wrote the recording."""
        return bool(np.array_equal(self.stamps, self.arrivals))

    @property
    def sweep(self) -> float:
        """Longest time, s, that slow messages may take beside what they state; 0 of usual sensors."""
        period = float(np.median(np.diff(self.stamps))) if len(self.stamps) > 1 else 0.0
        return 2 * period if period > _MAX_PERIOD else 0.0

    @property
    def delays(self) -> Array:
        """(N,) from the end of each measurement to its arrival, s."""
        sooner: Array = self.arrivals - self.stamps
        # Arrivals that come before the end of a measurement are times of its beginning.
        begins = bool(0 <= np.quantile(sooner, _QUICKEST) < self.duration)
        return sooner if begins else sooner - self.duration


@dataclass(frozen=True)
class ClockDifference:
    """The clock of a topic against that of most others."""

    offset: float
    """The clock minus that of the others, s."""
    stddev: float
    """Standard deviation, s."""
    certain: bool
    """Whether it is one of clocks for sure; otherwise the messages may be late by as much."""
    cause: str = ""
    """What it is, in words: a predicate of stamps; empty where that is not known."""

    def describe(self) -> str:
        """What the stamps are: a predicate."""
        side = "ahead of" if self.offset > 0 else "behind"
        if not self.certain:
            late = "" if self.offset > 0 else ", or the messages arrive as late"
            return f"may be {abs(self.offset):.1f} s {side} those of the others{late}"
        return (
            f"{self.cause or 'are of another clock'}: they are {abs(self.offset):.3f} s {side} those of the "
            f"others, by when the messages arrived (σ {self.stddev:.1f} s)"
        )


def read_arrivals(
    recording: Recording, topics: Collection[str], cache: RecordingCache = NO_CACHE
) -> dict[str, Arrivals]:
    """When the messages of some topics were stamped and arrived; only the first of each topic is decoded.

    Topics that the recording lacks, and those whose stamps are of no clock, are left out.
    """
    wanted = sorted(t.name for t in recording.topics if t.name in topics and t.time_base == "clock" and t.count)
    found = {
        topic: kept
        for topic in wanted
        if (kept := cache.read(recording, _FORMAT, {"topic": topic}, (Arrivals,))) is not None
    }
    unread = [topic for topic in wanted if topic not in found]
    if not unread:
        return found
    times = {topic: (array("d"), array("d")) for topic in unread}
    durations: dict[str, float] = {}
    for record in recording.records(unread):
        if record.topic not in durations:
            durations[record.topic] = _measure_duration(record.decode)
        stamps, arrivals = times[record.topic]
        stamps.append(record.stamp)
        arrivals.append(record.arrival)
    for topic, duration in durations.items():
        found[topic] = one = Arrivals(np.array(times[topic][0]), np.array(times[topic][1]), duration)
        cache.write(recording, _FORMAT, {"topic": topic}, one)
    return found


def measure_duration(message: Message) -> float:
    """Time from the stamp of a message to the end of its measurement, s; 0 where the message does not state it."""
    if isinstance(message, PointCloud):
        return float(message.times.max()) if message.times is not None and len(message.times) else 0.0
    return message.duration if isinstance(message, LaserScan) else 0.0


def _measure_duration(decode: Callable[[], Message]) -> float:
    try:
        return measure_duration(decode())
    except RecordingError:
        return 0.0  # an error that the use of the message reports


@dataclass(frozen=True)
class Clocks:
    """What the arrivals of a recording show of the clocks of its topics."""

    differences: Mapping[str, ClockDifference]
    """By topic whose clock differs, or may differ, from that of the others."""
    spans: Mapping[str, tuple[float, float]]
    """By topic, its first and last stamp, s."""
    informative: Collection[str]
    """The topics whose arrivals are no copies of their stamps."""
    corrected: Collection[str] = ()
    """The topics whose stamps were corrected by arrivals."""

    def certain_offsets(self) -> dict[str, float]:
        """By topic whose clock differs for sure, the offset to subtract from its stamps, s."""
        return {topic: one.offset for topic, one in self.differences.items() if one.certain}

    def after_correction(self, offsets: Mapping[str, float], by_arrival: Collection[str]) -> "Clocks":
        """The same after offsets, s, of topics were subtracted from their stamps, of some by arrivals."""
        spans = {t: (a - offsets.get(t, 0.0), b - offsets.get(t, 0.0)) for t, (a, b) in self.spans.items()}
        return replace(self, spans=spans, corrected=frozenset(by_arrival))

    def shares_time(self, topic: str, others: Collection[str]) -> str | None:
        """The first of some other topics whose stamps have some time in common with those of a topic."""
        spans = {name: self.spans[name] for name in (topic, *others) if name in self.spans}
        begin, end = spans.pop(topic, (np.inf, -np.inf))
        return next((name for name, (first, last) in spans.items() if first <= end and begin <= last), None)

    def stddev(self, topic: str) -> float:
        """Standard deviation of what is known of the topic's clock, s."""
        return self.differences[topic].stddev if topic in self.differences else _DELAY_STDDEV


UNKNOWN_CLOCKS = Clocks({}, {}, ())
"""Of a recording whose arrivals show nothing."""


def compare_clocks(recording: Recording, topics: Collection[str], cache: RecordingCache = NO_CACHE) -> Clocks:
    """Compares the clocks of a recording's topics.

    Recordings that were made together, and takes one after the other, have separate recorders: arrivals
    compare the topics of each.

    Args:
        recording: open recording.
        topics: of the sensors, and of triggers.
        cache: has the arrivals that earlier runs read.
    """
    parts = recording.parts if isinstance(recording, JoinedRecording) else (recording,)
    of_parts = [read_arrivals(part, topics, cache) for part in parts]
    differences = [find_differences(one) for one in of_parts]
    joined = {
        topic: _join(
            [found.get(topic) for read, found in zip(of_parts, differences, strict=True) if topic in read]
        )
        for topic in {topic for found in differences for topic in found}
    }
    return Clocks(
        {topic: one for topic in sorted(joined) if (one := joined[topic]) is not None},
        _join_spans(of_parts),
        {topic for read in of_parts for topic, one in read.items() if not one.are_stamps},
    )


def _join_spans(parts: Sequence[Mapping[str, Arrivals]]) -> dict[str, tuple[float, float]]:
    spans: dict[str, tuple[float, float]] = {}
    for topic, one in (item for read in parts for item in read.items()):
        begin, end = spans.get(topic, (np.inf, -np.inf))
        spans[topic] = min(begin, float(one.stamps.min())), max(end, float(one.stamps.max()))
    return spans


def _join(differences: Sequence[ClockDifference | None]) -> ClockDifference | None:
    """The difference that all parts of a recording show; None where they do not agree."""
    found = [one for one in differences if one is not None]
    agree = all(abs(one.offset - found[0].offset) <= 3 * (one.stddev + found[0].stddev) for one in found)
    return found[0] if agree and len(found) == len(differences) else None


def find_differences(topics: Mapping[str, Arrivals]) -> dict[str, ClockDifference]:
    """The clocks that differ from that of most, or may differ.

    Where no two topics agree, the clock of the recorder is that of the others.

    Args:
        topics: with at least one message each.

    Returns:
        By topic, its difference; none for those that have the clock of most.
    """
    # A clock that stands still has no offset.
    topics = {name: one for name, one in topics.items() if len(one.stamps) == 1 or np.ptp(one.stamps) > 0}
    if not topics:
        return {}
    shortest = {name: float(np.quantile(one.delays, _QUICKEST)) for name, one in topics.items()}
    # The recorder's own clock is one more: of messages that arrive without delay.
    members = np.array([0.0, *shortest.values()])
    agreeing = np.abs(members[:, None] - members[None, :]) <= _MAX_DELAY
    votes = agreeing.sum(axis=1)
    reference = min(range(len(members)), key=lambda k: (-votes[k], abs(members[k])))
    group = members[agreeing[reference]]
    of_recorder = bool(agreeing[reference, 0])
    if of_recorder:  # nothing arrives before it is measured
        group = group[group >= -_MAX_LEAD]
    typical = float(np.median(group))
    spread = estimate_spread(group - typical)
    of_recorder = of_recorder and abs(typical) < _MAX_LEAD
    found = {}
    for name, one in topics.items():
        difference = shortest[name] - typical
        slack = one.sweep
        of_delays = float(np.ptp(np.quantile(one.delays, [_QUICKEST, 1 - _QUICKEST])))
        impossible = of_recorder and shortest[name] < -_MAX_LEAD
        suspect = abs(difference) > _MIN_SUSPECT + slack or impossible
        # A difference that is not constant is that of a clock that was set meanwhile.
        if suspect and of_delays < max(abs(difference), _MAX_DELAY):
            stddev = max(_DELAY_STDDEV, spread, 0.1 * of_delays)
            offset, cause = _name_difference(-difference, one.stamps)
            certain = abs(difference) > _MAX_DELAY + slack or impossible
            found[name] = ClockDifference(offset, stddev, certain, cause)
    return found


def _name_difference(offset: float, stamps: Array) -> tuple[float, str]:
    """The offset, exact where its cause is known, and the cause."""
    for scale, name in _TIME_SCALES.items():
        if abs(abs(offset) - scale) <= _MAX_NAME_DISTANCE:
            return float(np.copysign(scale, offset)), f"differ by the leap seconds of {name}"
    zone = _ZONE_STEP * round(offset / _ZONE_STEP)
    if zone and abs(offset) < _MAX_ZONE and abs(offset - zone) <= _MAX_NAME_DISTANCE:
        return zone, "are of another time zone"
    if abs(offset) > _FIRST_DATE and float(np.median(stamps)) < _FIRST_DATE:
        return offset, "count from power-up"
    return offset, ""
