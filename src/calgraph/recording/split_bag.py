"""Several bags of one recording, one after the other, as one rosbag2 folder of several files."""

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from calgraph.io.yaml_reading import read_yaml
from calgraph.io.yaml_writing import save_yaml

_INFORMATION = "rosbag2_bagfile_information"


def join_bags(bags: Sequence[Path], folder: Path) -> None:
    """Moves the storage files of rosbag2 folders into a new one, as the recorder of ROS 2 writes split recordings.

    Args:
        bags: one or more, in the order of time; they are removed.
        folder: to create.
    """
    folder.mkdir()
    parts = [read_yaml(bag / "metadata.yaml")[_INFORMATION] for bag in bags]
    for bag, part in zip(bags, parts, strict=True):
        for name in part["relative_file_paths"]:
            (bag / name).rename(folder / name)
        shutil.rmtree(bag)
    save_yaml(folder / "metadata.yaml", {_INFORMATION: _join_metadata(parts)})


def _join_metadata(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    filled = [part for part in parts if part["message_count"]] or parts[:1]
    start = min(_start(part) for part in filled)
    end = max(_start(part) + part["duration"]["nanoseconds"] for part in filled)
    return {
        **parts[0],
        "duration": {"nanoseconds": end - start},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": sum(part["message_count"] for part in parts),
        "relative_file_paths": [name for part in parts for name in part["relative_file_paths"]],
        "files": [file for part in parts for file in part["files"]],
        "topics_with_message_count": _add_counts(parts),
    }


def _start(part: dict[str, Any]) -> int:
    return int(part["starting_time"]["nanoseconds_since_epoch"])


def _add_counts(parts: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each topic once, with the messages in all parts."""
    topics: dict[str, dict[str, Any]] = {}
    for part in parts:
        for entry in part["topics_with_message_count"]:
            topic = topics.setdefault(entry["topic_metadata"]["name"], {**entry, "message_count": 0})
            topic["message_count"] += entry["message_count"]
    return list(topics.values())
