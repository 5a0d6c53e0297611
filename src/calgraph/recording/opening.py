"""Opening recordings of any supported format."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from calgraph.errors import InputError
from calgraph.io.yaml_reading import suggest_name
from calgraph.recording.bag_files import find_bag_files
from calgraph.recording.bags import BagRecording
from calgraph.recording.folder import FolderRecording
from calgraph.recording.recording import JoinedRecording, Recording


def open_recording(path: Path) -> Recording:
    """Opens a recording; close it, or use it as a context manager.

    Args:
        path: a rosbag2 folder, an ``.mcap``, ``.db3`` or ROS 1 ``.bag`` file, a folder of those, or a plain
            folder with one folder per sensor.

    Raises:
        InputError: the path does not exist, or is not a recording.
        RecordingError: it is damaged.
    """
    if not path.exists():
        raise InputError(f"{path}: does not exist{suggest_name(path)}")
    bag = find_bag_files(path)
    if bag is not None:
        return BagRecording(path, bag)
    if path.is_dir():
        inner = [one for one in sorted(path.iterdir()) if one.is_dir() and find_bag_files(one) is not None]
        if inner:
            raise InputError(f"{path}: is no recording, but contains {', '.join(map(str, inner))}: give that")
        return FolderRecording(path)
    raise InputError(
        f"{path}: is not a recording; give a rosbag2 folder, an .mcap, .db3 or .bag file, or a folder with one "
        "folder of files per sensor"
    )


def open_recordings(paths: Sequence[Path]) -> Recording:
    """Opens several recordings as one, merged by arrival time.

    Raises:
        InputError: no path is given, or one of them is not a recording.
        RecordingError: one of them is damaged.
    """
    if not paths:
        raise InputError("no recording is given; at least one is needed")
    with ExitStack() as stack:
        recordings = [stack.enter_context(open_recording(path)) for path in paths]
        stack.pop_all()
    return recordings[0] if len(recordings) == 1 else JoinedRecording(recordings)
