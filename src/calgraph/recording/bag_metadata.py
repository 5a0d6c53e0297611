"""The files of a rosbag2 folder, and its metadata.yaml."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rosbags.interfaces import Connection

from calgraph.io.text_writing import save_yaml

METADATA = "metadata.yaml"
# Of the format of metadata.yaml, as ROS 2 Iron and later write and read it.
_METADATA_VERSION = 8


@dataclass(frozen=True)
class RecordedFile:
    """An MCAP of a recording."""

    path: Path
    start: int
    """Arrival of its first message, ns; likewise the last."""
    end: int
    connections: tuple[Connection, ...]

    @property
    def count(self) -> int:
        """Messages."""
        return sum(connection.msgcount for connection in self.connections)


def write_metadata(folder: Path, files: Sequence[RecordedFile]) -> None:
    """Writes metadata.yaml, which the tools of ROS 2 expect.

    Raises:
        InputError: it cannot be written.
    """
    start, end = min(file.start for file in files), max(file.end for file in files)
    counts: Counter[tuple[str, str, str]] = Counter()
    for file in files:
        for connection in file.connections:
            counts[connection.topic, connection.msgtype, connection.digest] += connection.msgcount
    content = {
        "version": _METADATA_VERSION,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": end - start},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": counts.total(),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": message_type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": "",
                    "type_description_hash": digest,
                },
                "message_count": count,
            }
            for (topic, message_type, digest), count in sorted(counts.items())
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.path.name for file in files],
        "files": [
            {
                "path": file.path.name,
                "starting_time": {"nanoseconds_since_epoch": file.start},
                "duration": {"nanoseconds": file.end - file.start},
                "message_count": file.count,
            }
            for file in files
        ],
        "custom_data": None,
        "ros_distro": "",
    }
    save_yaml(folder / METADATA, {"rosbag2_bagfile_information": content})
