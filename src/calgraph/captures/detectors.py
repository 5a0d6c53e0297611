"""One detector for every sensor of a rig, with what it learnt of the background."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

import numpy as np

from calgraph.captures.detect import Detect
from calgraph.config import CameraSpec, Lidar2dSpec, Lidar3dSpec, Rig
from calgraph.detection import Averaging, CameraDetector, CloudBackground, Detection, find_patches, find_segments
from calgraph.errors import InputError, Rejected
from calgraph.sensors import (
    CameraModel,
    LaserScan,
    Message,
    PointCloud,
    RecordedMessage,
    ScanBackground,
    convert_cloud_to_scan,
)

_log = logging.getLogger(__name__)

Background = CloudBackground | ScanBackground

# A background needs a few messages, but not thousands: a fast scanner sends enough in a second or two.
_ENOUGH = 60


def learn_backgrounds(
    records: Iterable[RecordedMessage], rig: Rig, *, progress: Callable[[float], None] | None = None
) -> Mapping[str, Background]:
    """Models of what the scanners see without target and operator.

    Args:
        records: the scanners' records in the background window.
        rig: the rig.
        progress: called with the arrival time of records.

    Returns:
        By scanner; no entry for one that measured nothing in the window.
    """
    by_topic = {spec.topic: name for name, spec in rig.sensors.items() if not isinstance(spec, CameraSpec)}
    seen: dict[str, list[Message]] = {}
    for record in records:
        if progress:
            progress(record.arrival)
        messages = seen.setdefault(by_topic[record.topic], [])
        if len(messages) < _ENOUGH:
            messages.append(record.decode())
    known: dict[str, Background] = {}
    for name in by_topic.values() if rig.capture.background else ():
        try:
            known[name] = background_of(seen.get(name, []), rig.sensors[name])
        except InputError as error:
            # One dead scanner does not keep the others from being calibrated.
            _log.warning("%s: %s; it looks for the board by size and shape", name, error)
    return known


def background_of(messages: Sequence[Message], spec: object) -> Background:
    """The model of one scanner's background."""
    if isinstance(spec, Lidar2dSpec):
        return ScanBackground.build(as_scans(messages))
    return CloudBackground.build([m for m in messages if isinstance(m, PointCloud)])


def as_scans(messages: Iterable[Message]) -> list[LaserScan]:
    """Scans of a 2-D scanner, also where its driver sends them as clouds."""
    return [
        m if isinstance(m, LaserScan) else convert_cloud_to_scan(m)
        for m in messages
        if isinstance(m, LaserScan | PointCloud)
    ]


def detectors(
    rig: Rig,
    cameras: Mapping[str, CameraModel],
    backgrounds: Mapping[str, Background],
    tags: Averaging,
    rng: np.random.Generator,
) -> Mapping[str, Detect]:
    """The detector of each sensor.

    Args:
        rig: the rig.
        cameras: intrinsics by camera.
        backgrounds: by scanner; those without one search by size and shape.
        tags: how a camera makes one plane of several tags.
        rng: source of the detectors' samples.
    """
    found: dict[str, Detect] = {}
    seeds = rng.integers(2**63, size=len(rig.sensors)).tolist()
    for (name, spec), seed in zip(rig.sensors.items(), seeds, strict=True):
        background = backgrounds.get(name)
        if isinstance(spec, CameraSpec):
            found[name] = CameraDetector(rig.boards, cameras[name], spec.noise, tags).find
        elif isinstance(spec, Lidar3dSpec):
            known = background if isinstance(background, CloudBackground) else None
            found[name] = partial(_patches, rig=rig, spec=spec, background=known, seed=seed)
        else:
            quiet = background if isinstance(background, ScanBackground) else None
            found[name] = partial(_segments, rig=rig, spec=spec, background=quiet, seed=seed)
    return found


def _patches(
    messages: Sequence[PointCloud], rig: Rig, spec: Lidar3dSpec, background: CloudBackground | None, seed: int
) -> tuple[Detection, ...] | Rejected:
    return find_patches(messages, rig.boards, spec.noise, background, _generator(seed, messages))


def _segments(
    messages: Sequence[Message], rig: Rig, spec: Lidar2dSpec, background: ScanBackground | None, seed: int
) -> tuple[Detection, ...] | Rejected:
    scans = as_scans(messages)
    return find_segments(scans, rig.boards, spec.noise, background, _generator(seed, scans))


def _generator(seed: int, messages: Sequence[PointCloud | LaserScan]) -> np.random.Generator:
    """Samples for one sensor and capture, the same in whatever order the captures are searched."""
    first = messages[0].stamp if messages else 0.0
    return np.random.default_rng([seed, int(np.float64(first).view(np.uint64))])
