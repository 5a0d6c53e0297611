"""The files of a simulation: its recording, rig.yaml and truth.yaml."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from calgraph.config import Rig
from calgraph.io.text_writing import save_yaml
from calgraph.recording.writer import RecordingWriter
from calgraph.simulation.truth import GroundTruth, save_truth

LATENCIES = 0.002, 0.02
"""Bounds of the time from the end of a measurement to its arrival at the recorder, s."""
Progress = Callable[[int, int], None]
"""Called with the number of messages written and in total."""


class SerializedMessage(NamedTuple):
    """A message as the recording has it."""

    arrival: int
    """ns."""
    topic: str
    ros_type: str
    data: bytes | memoryview
    """CDR."""


def describe_rig(rig: Rig) -> dict[str, Any]:
    """The content of a rig.yaml without settings."""
    return rig.model_dump(mode="json", exclude_none=True, exclude={"settings"})


def write_simulation(
    out: Path,
    rig: dict[str, Any],
    ground_truth: GroundTruth,
    messages: Iterable[SerializedMessage],
    progress: Callable[[int], object],
    max_file_duration: float = 0.0,
) -> None:
    """Writes ``out/recording`` (rosbag2, MCAP), ``out/rig.yaml`` and ``out/truth.yaml``.

    Args:
        out: folder, created if missing; it must not hold a recording yet.
        rig: content of rig.yaml.
        ground_truth: what truth.yaml states.
        messages: in order of arrival; they are asked for when the recording has been begun.
        progress: called with the number of messages written.
        max_file_duration: see :class:`calgraph.recording.writer.RecordingWriter`, s.

    Raises:
        InputError: there is a recording in ``out`` already.
    """
    with RecordingWriter(out / "recording", max_file_duration) as writer:
        for done, message in enumerate(messages, start=1):
            writer.write_serialized(message.topic, message.ros_type, message.data, message.arrival)
            progress(done)
    save_yaml(out / "rig.yaml", rig)
    save_truth(out / "truth.yaml", ground_truth)
