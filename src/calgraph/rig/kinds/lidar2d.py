"""2-D scanners of a rig: the board as a segment of a scan, and the motion in scans."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from calgraph.boards.detections import DetectionResult, Segment
from calgraph.config import Rig
from calgraph.config.settings import DetectionSettings
from calgraph.rig.detection.background_learning import learn_scan_background
from calgraph.rig.detection.lidar2d import find_segments
from calgraph.rig.kinds.rig_kind import (
    Detector,
    DetectorInputs,
    MotionSignature,
    RigKind,
    Signature,
    compare_values,
    make_generator,
    select_resting,
)
from calgraph.sensors import LaserScan, Message, ScanBackground
from calgraph.sensors.cloud_to_scan import to_scans
from calgraph.sensors.kinds import RangeNoise


def _make_detector(inputs: DetectorInputs) -> Detector:
    background = inputs.background if isinstance(inputs.background, ScanBackground) else None
    noise = inputs.rig.sensors[inputs.name].noise
    assert isinstance(noise, RangeNoise)
    return partial(_detect_segments, rig=inputs.rig, noise=noise, background=background, seed=inputs.seed)


def _detect_segments(
    messages: Sequence[Message], rig: Rig, noise: RangeNoise, background: ScanBackground | None, seed: int
) -> DetectionResult:
    scans = to_scans(messages)
    rng = make_generator(seed, scans)
    found = find_segments(scans, rig.boards, noise, background, rng, rig.settings.detection)
    return select_resting(found, scans)


def _learn_scans(messages: Sequence[Message], _: DetectionSettings) -> ScanBackground:
    return learn_scan_background(to_scans(messages))


# Range of a beam without return, m: farther than any wall, so that a return that appears is a change.
_NO_RETURN_RANGE = 100.0
# Change of a range, m, that counts as motion: more than twice the noise of a 2-D scanner (20 mm).
_MIN_RANGE_CHANGE = 0.05
# The same over the smaller of both ranges: noise of ranges and of angles of incidence grows with range.
_MIN_RANGE_CHANGE_RATIO = 0.02


def _list_ranges(message: LaserScan) -> Signature:
    """A beam without return counts as far: a return that appears or vanishes is a change."""
    return np.where(message.valid, message.ranges, _NO_RETURN_RANGE)


def _compare_ranges(before: Signature, after: Signature) -> float:
    def changed(a: Signature, b: Signature) -> Signature:
        min_change = np.maximum(_MIN_RANGE_CHANGE, _MIN_RANGE_CHANGE_RATIO * np.minimum(b, a))
        return np.asarray(np.abs(b - a) > min_change)

    return compare_values(before, after, changed)


# Largest share of the beams that differ in rests: 0.018 of a scanner with noise of 12 mm.
_NOISE = 0.03
# Bytes of a point of a preview, and most beams of a scan.
_PER_POINT, _BEAMS = 12.0, 2000

# Scans are decoded in a tenth of a millisecond each.
LIDAR2D = RigKind(
    detection=Segment,
    make_detector=_make_detector,
    max_messages=lambda limits: limits.lidar2d,
    messages_per_block=32,
    preview_bytes=lambda _, points: _PER_POINT * min(points, _BEAMS),
    motion={LaserScan: MotionSignature(_list_ranges, _compare_ranges, _NOISE)},
    learn_background=_learn_scans,
)
