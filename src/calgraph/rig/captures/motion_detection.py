"""How much a sensor's view changes within half a second; during a hold of the board nothing does."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from calgraph.rig.kinds import MOTION_SIGNATURES
from calgraph.rig.kinds.rig_kind import Signature
from calgraph.sensors import Message

# Time between the messages that are compared, s, as far as the sensor's period allows: the noise of a view does
# not grow with it, the share that a moving board changes does. It is the shortest hold.
BASELINE = 0.5
# Stamps of equal periods differ by less than this, s.
JITTER = 1e-3
# Change of a view, 0..1, below which activities are taken as equal, as their logarithms are compared: less than
# one beam of a thousand.
MIN_ACTIVITY = 1e-4


@dataclass(frozen=True, eq=False)
class Signed:
    """What is compared of a message."""

    stamp: float
    """s."""
    message_type: type[Message]
    signature: Signature


@dataclass(frozen=True, eq=False)
class ActivityBlock:
    """Changes among consecutive messages of one sensor."""

    changes: list[float]
    """As :meth:`ActivityMeter.measure_change`; those of ``first`` are not known yet."""
    first: list[tuple[int, Signed]]
    """Index and content of the messages that are to be compared with earlier ones."""
    last: list[Signed] | None
    """What later messages are to be compared with; None if that depends on earlier blocks."""


def measure_block(decoders: Sequence[Callable[[], Message]]) -> ActivityBlock:
    """The changes among messages, from functions that decode them."""
    meter = BlockMeter()
    for decode in decoders:
        meter.add(decode())
    return meter.block()


class BlockMeter:
    """Measures the changes among consecutive messages of one sensor, apart from those before them."""

    def __init__(self) -> None:
        self._meter = ActivityMeter(BASELINE)
        self._changes: list[float] = []
        self._first: list[tuple[int, Signed]] = []
        self._is_complete = False

    def add(self, message: Message) -> None:
        """Compares a message with an earlier one."""
        signed = _sign(message)
        if signed:
            # One baseline, and another by which messages may come late.
            begin = self._first[0][1].stamp if self._first else signed.stamp
            self._is_complete |= signed.stamp > begin + 2 * BASELINE + JITTER
            if not self._is_complete:
                self._first.append((len(self._changes), signed))
        self._changes.append(self._meter.compare(signed))

    def block(self) -> ActivityBlock:
        """The changes so far."""
        return ActivityBlock(self._changes, self._first, self._meter.recent if self._is_complete else None)


class ActivityMeter:
    """Compares each message of one sensor with an earlier one.

    Args:
        baseline: longest time between them, s; messages farther apart are compared with the one before.
        recent: messages before, in order of time.
    """

    def __init__(self, baseline: float, recent: Iterable[Signed] = ()) -> None:
        self.baseline = baseline
        self._recent = deque(recent)

    @property
    def recent(self) -> list[Signed]:
        """What later messages are to be compared with."""
        return list(self._recent)

    def join(self, block: ActivityBlock) -> list[float]:
        """The changes of the next messages, measured apart from those before."""
        changes = list(block.changes)
        for index, signed in block.first:
            changes[index] = self.compare(signed)
        if block.last is not None:
            self._recent = deque(block.last)
        return changes

    def measure_change(self, message: Message) -> float:
        """Share of the view, in 0..1, that differs from an earlier message; 0 for the first.

        NaN of messages without any return: they are lost data, and show neither motion nor rest.
        """
        return self.compare(_sign(message))

    def compare(self, signed: Signed | None) -> float:
        """The same, from what is compared of a message."""
        if signed is None:
            return float("nan")
        if not self._recent:
            self._recent.append(signed)
            return 0.0
        # A message that comes late counts as if it were of the time of the one before.
        signed = replace(signed, stamp=max(signed.stamp, self._recent[-1].stamp))
        since = signed.stamp - self.baseline - JITTER
        while len(self._recent) > 1 and self._recent[0].stamp < since:
            self._recent.popleft()
        before = self._recent[0]
        self._recent.append(signed)
        return MOTION_SIGNATURES[signed.message_type].compare(before.signature, signed.signature)


def _sign(message: Message) -> Signed | None:
    """What is compared of a message; None of those that show no motion."""
    motion = MOTION_SIGNATURES.get(type(message))
    if motion is None or getattr(message, "is_empty", False):
        return None
    return Signed(message.stamp, type(message), motion.compute(message))
