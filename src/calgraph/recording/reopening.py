"""Recordings that calls open where they run: in another process, or on another machine."""

import platform
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError, RecordingError
from calgraph.recording.clock_correction import ClockCorrectedRecording
from calgraph.recording.opening import open_recordings
from calgraph.recording.recording import Recording


@dataclass(frozen=True, eq=False)
class RecordingReference:
    """A recording, by the paths and URLs that it was opened from; with its messages if these are in memory."""

    recording: Recording | None
    """None if it is opened again."""
    opened_from: tuple[str, ...]
    limits: LimitSettings
    span: tuple[float, float]
    """Its start and end, s, by which it is recognized."""
    clock_offsets: Mapping[str, float]
    """By topic, the offset that is subtracted from its stamps, s; empty where the clocks are not corrected."""
    machine: str = field(default_factory=platform.node)
    """On which it was referred to."""

    def open(self) -> AbstractContextManager[Recording]:
        """The recording, to be closed with the block.

        Raises:
            InputError: it is not to be found on this machine.
            RecordingError: it is another one, has changed, or is damaged.
        """
        if self.recording is not None:
            return nullcontext(self.recording)
        here = "" if platform.node() == self.machine else f" on {platform.node()}"
        try:
            opened = open_recordings(self.opened_from, self.limits, again=True)
            if self.clock_offsets:
                opened = ClockCorrectedRecording(opened, self.clock_offsets)
        except InputError as error:
            if not here:
                raise
            raise InputError(
                f"{error};{here}: give a path or URL by which all workers of the cluster read it"
            ) from error
        if (opened.start, opened.end) != self.span:
            opened.close()
            raise RecordingError(
                f"{', '.join(self.opened_from)}: is another recording{here}, or was written to while it was read"
            )
        return opened


def refer_to(recording: Recording, limits: LimitSettings) -> RecordingReference:
    """Refers to an open recording; calls with the reference may run anywhere."""
    span = recording.start, recording.end
    in_memory = None if recording.opened_from else recording
    offsets = recording.clock_offsets if isinstance(recording, ClockCorrectedRecording) else {}
    return RecordingReference(in_memory, recording.opened_from, limits, span, offsets)
