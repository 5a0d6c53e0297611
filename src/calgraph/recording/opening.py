"""Opening recordings of any supported format."""

import logging
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError, RecordingError
from calgraph.io.yaml_reading import suggest_name
from calgraph.recording.bag_files import find_bag_files
from calgraph.recording.bags import BagRecording
from calgraph.recording.corners_csv import CornersRecording, is_corners
from calgraph.recording.folder import FolderRecording
from calgraph.recording.recording import JoinedRecording, Recording
from calgraph.recording.remote import fetch_recording, is_url
from calgraph.recording.takes import ClockCorrectedRecording, describe_takes, separate_takes
from calgraph.recording.trajectory_file import TrajectoryFile, is_trajectory
from calgraph.recording.video import VideoRecording, is_video

_log = logging.getLogger(__name__)
_Opened = BagRecording | CornersRecording | FolderRecording | JoinedRecording | TrajectoryFile | VideoRecording


def open_recording(path: Path | str, limits: LimitSettings = LimitSettings(), *, again: bool = False) -> Recording:
    """Opens a recording; close it, or use it as a context manager.

    Args:
        path: a rosbag2 folder, an ``.mcap``, ``.db3`` or ROS 1 ``.bag`` file, a folder of those, a video, a
            CSV of detected corners, a text file with a pose in each line, or a plain folder
            with one folder of files or one video per sensor; or the URL of one, see
            :mod:`calgraph.recording.remote`.
        limits: of what is read, ``settings.limits`` of rig.yaml.
        again: whether what is missing of it has been reported already.

    Raises:
        InputError: the path does not exist, or is not a recording.
        RecordingError: it is damaged.
    """
    url = str(path) if is_url(path) else None
    recording = _open(fetch_recording(url, limits) if url else Path(path), limits)
    recording.opened_from = (url or str(Path(path).absolute()),)
    for notice in recording.notices if isinstance(recording, BagRecording) and not again else ():
        _log.warning("%s", notice)
    return recording


def _open(path: Path, limits: LimitSettings) -> _Opened:
    if not path.exists():
        raise InputError(f"{path}: does not exist{suggest_name(path)}")
    bag = find_bag_files(path)
    if bag is not None:
        return BagRecording(path, bag, limits)
    if path.is_dir():
        inner = [one for one in sorted(path.iterdir()) if one.is_dir() and find_bag_files(one) is not None]
        if inner:
            raise InputError(f"{path}: is no recording, but contains {', '.join(map(str, inner))}: give that")
        return _open_folder(path, limits)
    if is_video(path):
        return VideoRecording(path, limits)
    if is_corners(path):
        return CornersRecording(path, limits)
    if is_trajectory(path):
        return TrajectoryFile(path, limits)
    raise InputError(
        f"{path}: is not a recording; give a rosbag2 folder, an .mcap, .db3 or .bag file, a video, or a folder "
        "with one folder of files or one video per sensor"
    )


def _open_folder(path: Path, limits: LimitSettings) -> _Opened:
    """A plain folder with folders of files, videos, detected corners, or several of these."""
    videos = list(_find_videos(path))
    with ExitStack() as stack:
        parts: list[_Opened] = [CornersRecording(path, limits)] if is_corners(path) else []
        parts += [stack.enter_context(VideoRecording(video, limits, topic)) for video, topic in videos]
        try:
            parts.append(stack.enter_context(FolderRecording(path, limits)))
        except InputError:
            if not parts:
                raise
            # Other images, such as previews, beside the recording.
        topics = [topic.name for part in parts for topic in part.topics]
        if twice := next((topic for topic in topics if topics.count(topic) > 1), ""):
            raise InputError(f"{path}: has two videos, or a video and a folder, of the name {twice}: rename one")
        stack.pop_all()
    return parts[0] if len(parts) == 1 and not videos else JoinedRecording(parts, path)


def _find_videos(path: Path) -> Iterator[tuple[Path, str]]:
    """The videos in a folder, and those that are alone in a folder of it, which names their topic."""
    for one in sorted(path.iterdir()):
        if is_video(one):
            yield one, one.stem
        elif one.is_dir():
            inner = [video for video in one.iterdir() if is_video(video)]
            if len(inner) == 1:
                yield inner[0], one.name


def open_recordings(
    paths: Sequence[Path | str], limits: LimitSettings = LimitSettings(), *, again: bool = False
) -> Recording:
    """Opens several recordings as one, merged by arrival time, and logs which of them were made together.

    Those that repeat a sensor at overlapping stamps are one after the other, see :mod:`calgraph.recording.takes`.
    Arguments are those of :func:`open_recording`.

    Raises:
        InputError: no path is given, one of them is not a recording, or two have the same messages.
        RecordingError: one of them is damaged.
    """
    if not paths:
        raise InputError("no recording is given; at least one is needed")
    with ExitStack() as stack:
        recordings = [stack.enter_context(open_recording(path, limits, again=again)) for path in paths]
        opened_from = tuple(path for one in recordings for path in one.opened_from)
        takes = separate_takes(recordings)
        stack.pop_all()
    if len(recordings) == 1:
        return recordings[0]
    if not again:
        _log.warning("%s", describe_takes(recordings, takes))
    joined = JoinedRecording(takes)
    joined.opened_from = opened_from
    return joined


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
