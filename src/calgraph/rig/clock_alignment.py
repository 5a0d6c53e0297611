"""The clocks of a rig's sensors: stamps by the root's clock, where rig.yaml states that they differ."""

import logging
from dataclasses import dataclass

from calgraph.config import Rig
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import ClockCorrectedRecording, Recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.result.finding import Finding
from calgraph.rig.captures.clock_alignment import ClockOffset, estimate_clock_offsets
from calgraph.rig.options import RigOptions
from calgraph.rig.rig_timeline import read_rig_timeline

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ClockAlignment:
    """A rig and its recording with all stamps by the root's clock."""

    rig: Rig
    """With estimated clock offsets as numbers."""
    recording: Recording
    findings: tuple[Finding, ...]
    """What was estimated, and whose clock remains unknown."""


def align_clocks(
    rig: Rig, recording: Recording, options: RigOptions, progress: Progress = no_progress
) -> ClockAlignment:
    """Corrects the stamps of the sensors whose clock offsets rig.yaml states or asks to estimate.

    Arguments are those of :func:`calgraph.calibrate_rig`. A clock that cannot be estimated is taken for
    that of the root, and the sensor's pose is weak.
    """
    offsets = {name: spec.clock_offset for name, spec in rig.sensors.items() if spec.clock_offset is not None}
    wanted = [name for name, offset in offsets.items() if offset == "estimate"]
    findings = []
    if wanted:
        monitor = InputMonitor(rig, recording.start)
        timeline = read_rig_timeline(rig, recording, monitor, options, progress)
        found = estimate_clock_offsets(timeline, rig.root, wanted)
        findings = [_describe(name, rig.root, found.get(name)) for name in wanted]
        offsets |= {name: found[name].offset if name in found else 0.0 for name in wanted}
    stated = {name: float(offset) for name, offset in offsets.items()}
    if any(stated.values()):
        by_topic = {rig.sensors[name].topic: offset for name, offset in stated.items()}
        recording = ClockCorrectedRecording(recording, by_topic)
    sensors = {
        name: spec.model_copy(update={"clock_offset": stated.get(name)}) for name, spec in rig.sensors.items()
    }
    return ClockAlignment(rig.model_copy(update={"sensors": sensors}), recording, tuple(findings))


def _describe(name: str, root: str, found: ClockOffset | None) -> Finding:
    if found is None:
        return Finding(
            f"the clock offset of {name} cannot be estimated: no offset stands out with which its view changes at "
            f"the times of that of {root}; move the board in view of both, at irregular times, or state it",
            (name,),
        )
    return Finding(
        f"the clock of {name} minus that of {root} is {found.offset:.3f} s, estimated from the times at which "
        f"their views change (correlation {found.correlation:.2f})"
    )
