"""3-D LiDARs of a rig: the board as a patch of a cloud, and the motion in clouds."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from calgraph.boards.detections import DetectionResult, PlanePatch
from calgraph.config import Rig
from calgraph.config.settings import DetectionSettings
from calgraph.errors import Rejected
from calgraph.rig.detection.background_learning import learn_cloud_background
from calgraph.rig.detection.capture_background import CaptureBackground, CloudBackground
from calgraph.rig.detection.lidar3d import find_patches
from calgraph.rig.kinds.rig_kind import (
    Detector,
    DetectorInputs,
    MotionSignature,
    RigKind,
    Signature,
    make_generator,
    select_resting,
)
from calgraph.sensors import Message, PointCloud
from calgraph.sensors.kinds import RangeNoise


def _make_detector(inputs: DetectorInputs) -> Detector:
    known = inputs.background
    background = known if isinstance(known, CloudBackground | CaptureBackground) else None
    noise = inputs.rig.sensors[inputs.name].noise
    assert isinstance(noise, RangeNoise)
    return partial(_detect_patches, rig=inputs.rig, noise=noise, background=background, seed=inputs.seed)


# Score of the best candidate in front of the static scene below which the whole cloud is searched: boards that
# are not occluded have 0.65 to 1.
_MIN_SCORE = 0.6


def _detect_patches(
    messages: Sequence[PointCloud],
    rig: Rig,
    noise: RangeNoise,
    background: CloudBackground | CaptureBackground | None,
    seed: int,
) -> DetectionResult:
    settings = rig.settings.detection

    def find(known: CloudBackground | CaptureBackground | None) -> tuple[PlanePatch, ...] | Rejected:
        return find_patches(messages, rig.boards, noise, known, make_generator(seed, messages), settings)

    found = find(background)
    is_found = not isinstance(found, Rejected) and found[0].match >= _MIN_SCORE
    if isinstance(background, CaptureBackground) and not is_found:
        # A board that stood in the same place in most captures is part of what was learned.
        found = find(None)
    return select_resting(found, messages)


def _learn_clouds(messages: Sequence[Message], settings: DetectionSettings) -> CloudBackground:
    return learn_cloud_background([m for m in messages if isinstance(m, PointCloud)], settings)


# Factors that pack the indices of a cell into one key, 21 bits an axis.
_PACK = np.array([1, 2**21, 2**42])
_WITH_NEIGHBOURS = np.array([0, *_PACK, *-_PACK])
# Cell by whose occupation two clouds are compared, m: points in cells next to occupied ones have not moved, as
# noise alone takes points across borders of cells.
_CELL = 0.2


def _list_cells(message: PointCloud) -> Signature:
    cells = np.floor(message.points / _CELL).astype(np.int64) + 2**20
    # NumPy's sets hash, which takes ten times longer than to sort here.
    keys = np.sort(cells @ _PACK)
    return keys[np.flatnonzero(np.diff(keys, prepend=keys[:1] - 1))]


def _compare_cells(before: Signature, after: Signature) -> float:
    changed = _count_far(after, before) + _count_far(before, after)
    return changed / max(len(after) + len(before), 1)


def _count_far(cells: Signature, others: Signature) -> int:
    """Number of cells that are not next to any of others."""
    near = np.append(np.sort((others[:, None] + _WITH_NEIGHBOURS).ravel()), -1)
    return int(np.count_nonzero(near[np.searchsorted(near[:-1], cells)] != cells))


# Largest share of the cells that differ in rests: 0.009 in simulated clouds of 16 rings, and three times that.
_NOISE = 0.03
# Bytes of a point of a preview.
_PER_POINT = 12.0

LIDAR3D = RigKind(
    detection=PlanePatch,
    make_detector=_make_detector,
    max_messages=lambda limits: limits.lidar3d,
    messages_per_block=4,
    preview_bytes=lambda _, points: _PER_POINT * points,
    motion={PointCloud: MotionSignature(_list_cells, _compare_cells, _NOISE)},
    learn_background=_learn_clouds,
    learns_from_captures=True,
)
