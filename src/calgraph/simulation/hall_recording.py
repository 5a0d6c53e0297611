"""The files of a simulated hall: recording, rig.yaml and ground truth."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from rosbags.typesys import Stores, get_typestore

from calgraph.io.text_writing import save_yaml
from calgraph.recording.writer import RecordingWriter, serialize_message
from calgraph.simulation.hall_scenario import HallScenario
from calgraph.simulation.hall_simulation import simulate_hall
from calgraph.simulation.truth import GroundTruth, save_truth


def record_hall(scenario: HallScenario, out: Path, progress: Callable[[int, int], None]) -> None:
    """Writes ``out/recording`` (rosbag2, MCAP), ``out/rig.yaml``, ``out/truth.yaml`` and ``out/scenario.yaml``.

    Args:
        scenario: hall, sensors and people.
        out: folder, created if missing; it must not hold a recording yet.
        progress: called with the number of messages written, and with that in total.

    Raises:
        InputError: there is no place for a person or a sensor, or a recording in ``out`` already.
    """
    simulated = simulate_hall(scenario)
    truth, store = simulated.truth, get_typestore(Stores.ROS2_HUMBLE)
    total = sum(topic.count for topic in simulated.recording.topics)
    with RecordingWriter(out / "recording") as writer:
        for done, record in enumerate(simulated.recording.records(), start=1):
            message = serialize_message(store, record.decode())
            writer.write_serialized(record.topic, *message, round(1e9 * record.arrival))
            progress(done, total)
    rig = simulated.rig.model_dump(mode="json", exclude_none=True, exclude={"settings"})
    save_yaml(out / "rig.yaml", rig)
    save_truth(out / "truth.yaml", GroundTruth(truth.root, truth.T_root_sensor, (), truth.clock_offsets))
    save_yaml(out / "scenario.yaml", asdict(scenario), f"seed: {scenario.seed}")
