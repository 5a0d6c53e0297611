"""Checks of all messages of a recording, in passing: frames, topics with the same data, changing intrinsics."""

from array import array
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.errors import RecordingError
from calgraph.result.finding import Finding
from calgraph.sensors import CameraInfo, CameraModel, RecordedMessage
from calgraph.sensors.kinds import KINDS


@dataclass(frozen=True, eq=False)
class TopicObservations:
    """What the checks need of all messages of one topic."""

    contents: NDArray[np.int64]
    """(N,) hashes of the contents of a sensor's messages."""
    frames: Mapping[str, float]
    """Frames that a sensor's messages state, with the stamp of the first that does, s."""
    change: str = ""
    """How the intrinsics on the topic differ from the first; empty if they do not."""
    changed_at: float = 0.0
    """Stamp of the first message with others, s."""


@dataclass
class _Observer:
    """Collects what the checks need of one topic."""

    contents: "array[int]" = field(default_factory=lambda: array("q"))
    frames: dict[str, float] = field(default_factory=dict)
    decoded: set[int] = field(default_factory=set)
    """Hashes of the intrinsics that were decoded."""
    first: CameraModel | None = None
    change: str = ""
    changed_at: float = 0.0


# Minimum number of different messages that both topics have: a covered scanner, or a dark image, repeats one.
_MIN_IDENTICAL_MESSAGES = 3
# Share of identical messages beyond which two topics carry the data of one sensor; of two sensors almost no
# message is identical, as noise differs, and a relay that drops messages passes most.
_MAX_IDENTICAL_SHARE = 0.5
# Maximum change of K over the focal length, and of a distortion coefficient, that is rounding: values with six
# digits, or single precision; it moves a pixel by 0.01 px.
MAX_INTRINSICS_CHANGE = 1e-5


class InputMonitor:
    """Collects what the checks need while a recording is read, and reports what does not fit the rig.

    Args:
        rig: the rig; its settings have the limits of the checks.
        start: of the recording, s; the times in findings count from here.
        camera_infos: topic with its intrinsics, by camera whose intrinsics are taken from the recording.
    """

    def __init__(self, rig: Rig, start: float, camera_infos: Mapping[str, str] | None = None) -> None:
        self._rig, self._start = rig, start
        self._camera_infos = dict(camera_infos or {})
        self._observers = {topic: _Observer() for topic in (*rig.topics.values(), *self._camera_infos.values())}

    @property
    def topics(self) -> Collection[str]:
        """The topics that are observed."""
        return self._observers.keys()

    @property
    def camera_info_topics(self) -> tuple[str, ...]:
        """The topics with intrinsics that are to be observed, too."""
        return tuple(dict.fromkeys(self._camera_infos.values()))

    def observe(self, records: Iterable[RecordedMessage]) -> Iterator[RecordedMessage]:
        """Passes records on after noting what the checks need."""
        sensor_topics = set(self._rig.topics.values())
        for record in records:
            observer = self._observers.get(record.topic)
            if record.digest is not None and observer is not None:
                digest = record.digest()
                if record.topic in sensor_topics:
                    observer.contents.append(digest.content)
                    if digest.frame_id:
                        observer.frames.setdefault(digest.frame_id, record.stamp)
                else:
                    self._add_camera_info(observer, record, digest.content)
            yield record

    def observations(self, topic: str) -> TopicObservations:
        """What was noted of a topic so far."""
        noted = self._observers[topic]
        return TopicObservations(np.array(noted.contents, np.int64), noted.frames, noted.change, noted.changed_at)

    def restore(self, topic: str, observations: TopicObservations) -> None:
        """Takes what was noted of a topic in an earlier run."""
        self._observers[topic] = _Observer(
            array("q", observations.contents.tolist()),
            dict(observations.frames),
            change=observations.change,
            changed_at=observations.changed_at,
        )

    def findings(self) -> tuple[Finding, ...]:
        """What does not fit the rig, in the messages observed so far."""
        return (*self._check_frames(), *self._check_duplicates(), *self._check_camera_infos())

    def _check_frames(self) -> Iterator[Finding]:
        for name, spec in self._rig.sensors.items():
            if not KINDS[spec.kind].states_frame:
                continue
            stamps = self._observers[spec.topic].frames
            frames = list(stamps)
            if len(frames) > 1:
                at = stamps[frames[1]] - self._start
                yield Finding(
                    f"messages of {name} state the frame {frames[0]}, and {frames[1]} from {at:.1f} s on: "
                    "give each sensor its own topic, and do not reconfigure drivers while recording"
                )
            # ROS 1 drivers may write a leading slash, which tf removes.
            elif frames and spec.frame_id and frames[0].lstrip("/") != spec.frame_id.lstrip("/"):
                yield Finding(
                    f"messages of {name} state the frame {frames[0]}, rig.yaml states {spec.frame_id}: correct "
                    "frame_id if it is wrong, as exports use the frame of rig.yaml"
                )

    def _check_duplicates(self) -> Iterator[Finding]:
        # Of tf, one topic has the trajectories of several frames.
        topics: dict[str, str] = {}
        for name, topic in self._rig.topics.items():
            topics.setdefault(topic, name)
        distinct = {name: np.unique(np.asarray(self._observers[topic].contents)) for topic, name in topics.items()}
        for (a, b), shared in _count_shared(distinct).items():
            share = shared / min(len(distinct[a]), len(distinct[b]))
            if shared >= _MIN_IDENTICAL_MESSAGES and share > _MAX_IDENTICAL_SHARE:
                yield Finding(
                    f"{a} and {b} have the same data, {100 * share:.0f} % of their messages are identical: state "
                    "the topic of each sensor, or remove one of them",
                    tuple(name for name in (a, b) if name != self._rig.root),
                )

    def _check_camera_infos(self) -> Iterator[Finding]:
        for name, topic in self._camera_infos.items():
            history = self._observers[topic]
            if not history.change:
                continue
            others = tuple(other for other in self._rig.sensors if other != self._rig.root)
            yield Finding(
                f"the intrinsics of {name} on {topic} change at {history.changed_at - self._start:.1f} s "
                f"({history.change}), those before are used: switch autofocus and zoom off, and record again",
                others if name == self._rig.root else (name,),
            )

    def _add_camera_info(self, history: _Observer, record: RecordedMessage, content: int) -> None:
        if history.change or content in history.decoded:
            return
        history.decoded.add(content)
        try:
            message = record.decode()
        except RecordingError:
            message = None
        if history.first is None:
            history.first = message.camera if isinstance(message, CameraInfo) else None
        elif not isinstance(message, CameraInfo):
            history.change, history.changed_at = "to values that cannot be used", record.stamp
        else:
            limit = MAX_INTRINSICS_CHANGE
            history.change, history.changed_at = (
                _describe_change(history.first, message.camera, limit),
                record.stamp,
            )


def _count_shared(contents: Mapping[str, NDArray[np.int64]]) -> dict[tuple[str, str], int]:
    """By pair of sensors with any, the number of contents that both have."""
    names = list(contents)
    values = np.concatenate([contents[name] for name in names])
    owners = np.repeat(np.arange(len(names)), [len(contents[name]) for name in names])
    order = np.argsort(values, kind="stable")
    values, owners = values[order], owners[order]
    groups = np.split(owners, np.flatnonzero(np.diff(values)) + 1) if (values[1:] == values[:-1]).any() else []
    counts = Counter(pair for group in groups if len(group) > 1 for pair in combinations(group.tolist(), 2))
    return {(names[i], names[j]): count for (i, j), count in sorted(counts.items())}


def _describe_change(before: CameraModel, after: CameraModel, limit: float) -> str:
    """What differs between two camera models by more than ``limit`` times the focal length; empty if nothing."""
    if (before.model, before.width, before.height) != (after.model, after.width, after.height):
        return (
            f"{before.model}, {before.width} x {before.height} pixels to {after.model}, "
            f"{after.width} x {after.height} pixels"
        )
    change = np.abs(after.K - before.K)
    i, j = np.unravel_index(np.argmax(change), change.shape)
    if change[i, j] > limit * before.K[0, 0]:
        name = {(0, 0): "fx", (1, 1): "fy", (0, 2): "cx", (1, 2): "cy"}.get((int(i), int(j)), "K")
        return f"{name} {before.K[i, j]:.6g} to {after.K[i, j]:.6g} pixels"
    if (
        before.distortion.shape != after.distortion.shape
        or (np.abs(after.distortion - before.distortion) > limit).any()
    ):
        return f"distortion {before.distortion.tolist()} to {after.distortion.tolist()}"
    return ""
