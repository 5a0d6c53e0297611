"""The clocks of sensors, as far as arrivals determine them."""

from collections.abc import Mapping
from dataclasses import replace

from calgraph.config import Rig
from calgraph.recording import Recording, RecordingCache, correct_stamps
from calgraph.recording.clocks import compare_clocks
from calgraph.result import Calibration
from calgraph.result.finding import Finding


def correct_clocks(
    rig: Rig, recording: Recording, cache: RecordingCache
) -> tuple[Recording, dict[str, float], list[Finding]]:
    """The recording by one clock, the offsets subtracted by topic, s, and a remark on each.

    What remains, some tenths of a second, is estimated from what sensors measure.
    """
    clocks = compare_clocks(recording, list(rig.topics.values()), cache)
    offsets = clocks.certain_offsets()
    findings = [
        Finding(f"the stamps of {name} {clocks.differences[topic].describe()}, and were corrected")
        for name, topic in rig.topics.items()
        if topic in offsets
    ]
    return correct_stamps(recording, offsets), offsets, findings


def add_clock_offsets(calibration: Calibration, rig: Rig, offsets: Mapping[str, float]) -> Calibration:
    """The calibration with the clock offsets of the recording as it is, of whose topics some were corrected."""
    of_root = offsets.get(rig.topics[rig.reference], 0.0)
    # An extended calibration may have sensors that the rig lacks.
    others = rig.topics.keys() - {rig.reference}
    sensors = [
        sensor
        if sensor.clock_offset is None or sensor.name not in others
        else replace(
            sensor, clock_offset=sensor.clock_offset + offsets.get(rig.topics[sensor.name], 0.0) - of_root
        )
        for sensor in calibration.sensors
    ]
    return replace(calibration, sensors=tuple(sensors)) if offsets else calibration
