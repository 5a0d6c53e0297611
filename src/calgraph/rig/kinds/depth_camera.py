"""Depth cameras of a rig: the board as a patch of the cloud that an image measures."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from calgraph.boards.detections import DetectionResult, PlanePatch
from calgraph.errors import Rejected
from calgraph.rig.kinds.lidar3d import LIDAR3D
from calgraph.rig.kinds.rig_kind import Detector, DetectorInputs


def _make_detector(inputs: DetectorInputs) -> Detector:
    return partial(_detect_patches, LIDAR3D.make_detector(inputs))


def _detect_patches(detect: Detector, messages: Sequence[Any]) -> DetectionResult:
    """The patches without their edges: matching windows move the outlines of what is near by several pixels."""
    found = detect(messages)
    if isinstance(found, Rejected):
        return found
    return tuple(replace(one, edges=np.empty((0, 2, 3))) if isinstance(one, PlanePatch) else one for one in found)


# Clouds of a depth camera are those of a LiDAR without rings; their type has its motion there.
DEPTH_CAMERA = replace(LIDAR3D, make_detector=_make_detector, motion={})
